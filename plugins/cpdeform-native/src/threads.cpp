#include "threads.h"

#include <unistd.h>

#include <new>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace cpdeform {

namespace {

// Between two questions whether a call is to end: short for a person, long for a computer.
constexpr std::chrono::milliseconds question_interval{20};

void pause_briefly() {
#if defined(__x86_64__)
  _mm_pause();
#endif
}

}  // namespace

const char* Interrupted::what() const noexcept { return "interrupted"; }
const char* Abandoned::what() const noexcept { return "another thread failed"; }
void throw_interrupted() { throw Interrupted(); }
void Team::abandon() { throw Abandoned(); }

Team::Team(int threads, Asker asker) : size_(threads < 1 ? 1 : threads), asker_(asker) {}

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
  for (int thread = 1; thread < size_; ++thread) shared_->workers.emplace_back(&Team::loop, this, std::ref(*shared_), thread);
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
    const std::exception_ptr error = guarded(*work, thread);
    std::lock_guard<std::mutex> lock(shared.mutex);
    if (error && !shared.error) shared.error = error;
    if (--shared.running == 0) shared.done.notify_all();
  }
}

// One thread's share of a call. A thread that fails leaves no other waiting at a barrier. Returns its exception.
std::exception_ptr Team::guarded(const std::function<void(int)>& work, int thread) {
  try {
    work(thread);
    return nullptr;
  } catch (const Abandoned&) {
    return nullptr;
  } catch (...) {
    broken_.store(true, std::memory_order_release);
    round_.fetch_add(1, std::memory_order_release);
    round_.notify_all();
    return std::current_exception();
  }
}

bool Team::interrupted(int thread) {
  if (thread == 0 && asker_ && !ending_.load(std::memory_order_relaxed)) {
    const auto now = std::chrono::steady_clock::now();
    if (now >= next_question_) {
      next_question_ = now + question_interval;
      if (asker_()) ending_.store(true, std::memory_order_relaxed);
    }
  }
  return ending_.load(std::memory_order_relaxed);
}

void Team::take_turn() {
  while (!calls_.try_lock_for(question_interval))
    if (asker_ && asker_()) throw_interrupted();
}

void Team::run(const std::function<void(int)>& work) {
  take_turn();
  std::lock_guard<std::timed_mutex> turn(calls_, std::adopt_lock);
  ending_.store(false);
  next_question_ = {};
  if (size_ == 1) {
    work(0);
  } else {
    run_with_workers(work);
  }
  // the asker may have said so when the work was done: it has been heard all the same
  if (ending_.load()) throw_interrupted();
}

void Team::run_with_workers(const std::function<void(int)>& work) {
  start();
  Shared& shared = *shared_;
  broken_.store(false);
  arrived_.store(0);
  {
    std::lock_guard<std::mutex> lock(shared.mutex);
    shared.work = &work;
    shared.error = nullptr;
    shared.running = size_ - 1;
    ++shared.generation;
  }
  shared.wake.notify_all();
  const std::exception_ptr mine = guarded(work, 0);
  std::unique_lock<std::mutex> lock(shared.mutex);
  while (!shared.done.wait_for(lock, question_interval, [&] { return shared.running == 0; })) {
    lock.unlock();
    interrupted(0);
    lock.lock();
  }
  if (ending_.load()) throw_interrupted();
  if (mine) std::rethrow_exception(mine);
  if (shared.error) std::rethrow_exception(shared.error);
}

void Team::wait_for_round(unsigned round) {
  // phases take tens of microseconds: spin that long before asking the system to wait
  for (int spin = 0; spin < 4000 && round_.load(std::memory_order_acquire) == round; ++spin) pause_briefly();
  while (round_.load(std::memory_order_acquire) == round) round_.wait(round, std::memory_order_acquire);
  if (broken_.load(std::memory_order_acquire)) abandon();
}

}  // namespace cpdeform
