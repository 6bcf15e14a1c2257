#include "threads.h"

#include <unistd.h>

#include <new>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace cpdeform {

namespace {

void pause_briefly() {
#if defined(__x86_64__)
  _mm_pause();
#endif
}

}  // namespace

Team::Team(int threads) : size_(threads < 1 ? 1 : threads) {}

Team::~Team() {
  if (!shared_ || process_ != static_cast<long>(getpid())) return;
  {
    std::lock_guard<std::mutex> lock(shared_->mutex);
    shared_->stop = true;
  }
  shared_->wake.notify_all();
  for (std::thread& worker : shared_->workers) worker.join();
  delete shared_;
}

void Team::start() {
  const long process = static_cast<long>(getpid());
  if (shared_ && process_ == process) return;
  process_ = process;
  shared_ = new Shared;
  arrived_.store(0);
  for (int thread = 1; thread < size_; ++thread) shared_->workers.emplace_back(loop, std::ref(*shared_), thread);
}

void Team::loop(Shared& shared, int thread) {
  unsigned seen = 0;
  for (;;) {
    const std::function<void(int)>* work;
    {
      std::unique_lock<std::mutex> lock(shared.mutex);
      shared.wake.wait(lock, [&] { return shared.stop || shared.generation != seen; });
      if (shared.stop) return;
      seen = shared.generation;
      work = shared.work;
    }
    std::exception_ptr error;
    try {
      (*work)(thread);
    } catch (...) {
      error = std::current_exception();
    }
    std::lock_guard<std::mutex> lock(shared.mutex);
    if (error && !shared.error) shared.error = error;
    if (--shared.running == 0) shared.done.notify_all();
  }
}

void Team::run(const std::function<void(int)>& work) {
  std::lock_guard<std::mutex> turn(calls_);
  if (size_ == 1) {
    work(0);
    return;
  }
  start();
  Shared& shared = *shared_;
  {
    std::lock_guard<std::mutex> lock(shared.mutex);
    shared.work = &work;
    shared.error = nullptr;
    shared.running = size_ - 1;
    ++shared.generation;
  }
  shared.wake.notify_all();
  std::exception_ptr mine;
  try {
    work(0);
  } catch (...) {
    mine = std::current_exception();
  }
  std::unique_lock<std::mutex> lock(shared.mutex);
  shared.done.wait(lock, [&] { return shared.running == 0; });
  if (mine) std::rethrow_exception(mine);
  if (shared.error) std::rethrow_exception(shared.error);
}

void Team::wait_for_round(unsigned round) {
  // phases take tens of microseconds: spin that long before asking the system to wait
  for (int spin = 0; spin < 4000; ++spin) {
    if (round_.load(std::memory_order_acquire) != round) return;
    pause_briefly();
  }
  while (round_.load(std::memory_order_acquire) == round) round_.wait(round, std::memory_order_acquire);
}

}  // namespace cpdeform
