// Compiled once for each instruction set: see kernels.hpp.
#include "kernels.hpp"

#include "search_edges.hpp"
#include "search_neighbours.hpp"

namespace l3ps {
namespace L3PS_ISA {

extern const Kernels kernels;
const Kernels kernels{L3PS_ISA_NAME, neighbours, propose_known, search};

}  // namespace L3PS_ISA
}  // namespace l3ps
