// A team of threads that stays alive between calls, and its barrier.
#pragma once

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace cpdeform {

// Ends a call that was asked to end. Defined in threads.cpp, as all that kernels call: an inline function would be compiled for every
// instruction set, and the linker would keep one of them for all.
class Interrupted : public std::exception {
 public:
  const char* what() const noexcept override;
};
[[noreturn]] void throw_interrupted();

// Ends a thread at a barrier that another thread, which failed, will never reach. That one's exception is the one that counts.
class Abandoned : public std::exception {
 public:
  const char* what() const noexcept override;
};

class Team {
 public:
  // Whether a call is to end, e.g. because of a signal.
  using Asker = bool (*)();

  // `asker` is called now and then by the thread that called `run`, and by no other.
  explicit Team(int threads, Asker asker = nullptr);
  ~Team();
  Team(const Team&) = delete;
  Team& operator=(const Team&) = delete;

  int size() const { return size_; }

  // Call work(thread) once on each of size() threads, this one included, and wait for all. The first exception is thrown again;
  // Interrupted where the asker wanted the call to end.
  // One call at a time: callers on other threads wait for their turn. After a fork the child's first call starts new threads.
  void run(const std::function<void(int)>& work);

  // Whether the running call is to end. Long loops ask this often, each thread with its number; thread 0 asks the asker a few dozen
  // times a second. Whoever hears yes throws Interrupted, or goes on to a barrier where all of its kind do.
  bool interrupted(int thread);

  // Wait for all threads of the running call. The last to arrive runs `completion` before anyone goes on. It must not throw.
  template <class F>
  void barrier(F&& completion) {
    if (size_ == 1) {
      completion();
      return;
    }
    const unsigned round = round_.load(std::memory_order_acquire);
    if (broken_.load(std::memory_order_acquire)) abandon();
    if (arrived_.fetch_add(1, std::memory_order_acq_rel) + 1 == size_) {
      completion();
      arrived_.store(0, std::memory_order_relaxed);
      round_.store(round + 1, std::memory_order_release);
      round_.notify_all();
    } else {
      wait_for_round(round);
    }
  }
  void barrier() {
    barrier([] {});
  }

 private:
  // What the threads of one process share. A forked child inherits a state in which threads wait that it does not have, and which
  // can be neither used nor destroyed: it leaves it behind and makes its own.
  struct Shared {
    std::vector<std::thread> workers;
    std::mutex mutex;
    std::condition_variable wake, done;
    const std::function<void(int)>* work = nullptr;
    unsigned generation = 0;
    int running = 0;
    bool stop = false;
    std::exception_ptr error;
  };

  void start();
  void loop(Shared& shared, int thread);
  std::exception_ptr guarded(const std::function<void(int)>& work, int thread);
  void take_turn();
  void run_with_workers(const std::function<void(int)>& work);
  void wait_for_round(unsigned round);
  [[noreturn]] static void abandon();

  int size_;
  Asker asker_;
  long process_ = 0;
  Shared* shared_ = nullptr;
  std::timed_mutex calls_;
  std::atomic<unsigned> round_{0};
  std::atomic<int> arrived_{0};
  std::atomic<bool> broken_{false};  // a thread of the running call failed
  std::atomic<bool> ending_{false};  // the running call is to end
  std::chrono::steady_clock::time_point next_question_;  // of thread 0
};

}  // namespace cpdeform
