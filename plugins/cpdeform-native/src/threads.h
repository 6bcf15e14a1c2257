// A team of threads that stays alive between calls, and its barrier.
#pragma once

#include <atomic>
#include <condition_variable>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace cpdeform {

class Team {
 public:
  explicit Team(int threads);
  ~Team();
  Team(const Team&) = delete;
  Team& operator=(const Team&) = delete;

  int size() const { return size_; }

  // Call work(thread) once on each of size() threads, this one included, and wait for all. The first exception is thrown again.
  // One call at a time: callers on other threads wait for their turn. After a fork the child's first call starts new threads.
  void run(const std::function<void(int)>& work);

  // Wait for all threads of the running call. The last to arrive runs `completion` before anyone goes on. It must not throw.
  template <class F>
  void barrier(F&& completion) {
    if (size_ == 1) {
      completion();
      return;
    }
    const unsigned round = round_.load(std::memory_order_acquire);
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
  static void loop(Shared& shared, int thread);
  void wait_for_round(unsigned round);

  int size_;
  long process_ = 0;
  Shared* shared_ = nullptr;
  std::mutex calls_;
  std::atomic<unsigned> round_{0};
  std::atomic<int> arrived_{0};
};

}  // namespace cpdeform
