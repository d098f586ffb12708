// Which copy of the kernels this processor runs.
#include "kernels.hpp"

namespace l3ps {

namespace baseline { extern const Kernels kernels; }
#if defined(L3PS_WITH_AVX2)
namespace avx2 { extern const Kernels kernels; }
#endif
#if defined(L3PS_WITH_AVX512)
namespace avx512 { extern const Kernels kernels; }
#endif

const Kernels& kernels() {
    static const Kernels& chosen = []() -> const Kernels& {
#if defined(L3PS_WITH_AVX512)
        if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
            __builtin_cpu_supports("avx512bw")) {
            return avx512::kernels;
        }
#endif
#if defined(L3PS_WITH_AVX2)
        if (__builtin_cpu_supports("avx2")) return avx2::kernels;
#endif
        return baseline::kernels;
    }();
    return chosen;
}

}  // namespace l3ps
