// Where the time goes, for builds with -DCPDEFORM_PROFILE=ON: clock ticks of each kind of work, summed over threads.
#pragma once

#include <atomic>
#include <cstdint>

namespace cpdeform {

enum class Phase : int { sorting, material, records, scatter, gather, grid, tools, other, count };

#if defined(CPDEFORM_PROFILE) && defined(__x86_64__)

inline std::atomic<uint64_t> phase_ticks[int(Phase::count)];

class Stopwatch {
 public:
  explicit Stopwatch(Phase phase) : phase_(phase), start_(__builtin_ia32_rdtsc()) {}
  ~Stopwatch() { stop(); }
  // Count the time since the last change for the phase so far.
  void change(Phase phase) {
    const uint64_t now = __builtin_ia32_rdtsc();
    ticks_[int(phase_)] += now - start_;
    start_ = now;
    phase_ = phase;
  }

 private:
  void stop() {
    change(phase_);
    for (int p = 0; p < int(Phase::count); ++p)
      if (ticks_[p]) phase_ticks[p].fetch_add(ticks_[p], std::memory_order_relaxed);
  }
  Phase phase_;
  uint64_t start_;
  uint64_t ticks_[int(Phase::count)] = {};
};

#else

struct Stopwatch {
  explicit Stopwatch(Phase) {}
  void change(Phase) {}
};

#endif

}  // namespace cpdeform
