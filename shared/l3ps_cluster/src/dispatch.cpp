// Which copy of the kernels runs.
#include <atomic>
#include <cstring>

#include "kernels.hpp"

namespace l3ps {

namespace baseline {
extern const Kernels kernels;
}
#if defined(L3PS_WITH_AVX2)
namespace avx2 {
extern const Kernels kernels;
}
#endif

namespace {

// Those that this processor runs, the best one first.
const std::vector<const Kernels*>& runnable() {
    static const std::vector<const Kernels*> all = [] {
        std::vector<const Kernels*> found;
#if defined(L3PS_WITH_AVX2)
        // x86-64-v3, for which it was built, has all of these.
        if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2")) {
            found.push_back(&avx2::kernels);
        }
#endif
        found.push_back(&baseline::kernels);
        return found;
    }();
    return all;
}

std::atomic<const Kernels*> chosen{nullptr};

}  // namespace

const Kernels& kernels() {
    const Kernels* now = chosen.load(std::memory_order_relaxed);
    return now ? *now : *runnable().front();
}

bool choose_kernels(const char* name) {
    for (const Kernels* each : runnable()) {
        if (std::strcmp(each->name, name) != 0) continue;
        chosen.store(each, std::memory_order_relaxed);
        return true;
    }
    return false;
}

}  // namespace l3ps
