// Threads that live as long as a training and sleep between its steps.
//
// Work is taken part by part from a shared counter, so that a thread which the system has put aside holds up no more
// than the part it is at. A thread that has nothing to do looks for more for some microseconds, which is shorter than
// falling asleep and being woken, and then sleeps: it takes no processor from whoever else needs one.
#pragma once

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <new>
#include <thread>
#include <vector>

namespace pop {

class Pool {
public:
  explicit Pool(int64_t threads) {
    try {
      for (int64_t k = 1; k < threads; k++) others.emplace_back([this, k] { work_until_closed(int(k)); });
    } catch (...) {
      // the system has no more threads: those that there are share the work
    }
  }
  Pool(const Pool &) = delete;
  Pool &operator=(const Pool &) = delete;
  ~Pool() {
    {
      const std::lock_guard<std::mutex> lock(mutex);
      closed = true;
      round++;
    }
    wake.notify_all();
    for (auto &other : others) other.join();
  }

  int64_t size() const { return int64_t(others.size()) + 1; }

  // Call f(thread, first, last) for parts of n until none is left; what is thrown by one ends the call once all are back.
  template <class F> void share(int64_t n, int64_t part, F f) {
    if (n <= 0) return;
    next = 0;
    failed = false;
    auto parts = [&](int thread) {
      try {
        for (int64_t first; (first = next.fetch_add(part)) < n;) f(thread, first, std::min(n, first + part));
      } catch (...) {
        failed = true;
        next = n;
      }
    };
    if (others.empty() || n <= part) {
      parts(0);
    } else {
      using Parts = decltype(parts);
      call = [](void *given, int thread) { (*static_cast<Parts *>(given))(thread); };
      given = &parts;
      at_work = int(others.size());
      {
        const std::lock_guard<std::mutex> lock(mutex);
        round++;
      }
      wake.notify_all();
      parts(0);
      wait_for([&] { return at_work.load() == 0; }, done);
    }
    if (failed) throw std::bad_alloc();
  }

private:
  std::vector<std::thread> others;
  std::mutex mutex;
  std::condition_variable wake, done;
  std::atomic<uint64_t> round{0};
  std::atomic<int64_t> next{0};
  std::atomic<int> at_work{0};
  std::atomic<bool> failed{false}, closed{false};
  void (*call)(void *, int) = nullptr;
  void *given = nullptr;

  static void pause() {
#if defined(__x86_64__) || defined(__i386__)
    __builtin_ia32_pause();
#endif
  }

  template <class Condition> void wait_for(Condition holds, std::condition_variable &signal) {
    for (int look = 0; look < 600; look++) {
      if (holds()) return;
      pause();
    }
    std::unique_lock<std::mutex> lock(mutex);
    signal.wait(lock, holds);
  }

  void work_until_closed(int thread) {
    for (uint64_t seen = 0;;) {
      wait_for([&] { return round.load() != seen; }, wake);
      seen = round.load();
      if (closed) return;
      call(given, thread);
      if (at_work.fetch_sub(1) == 1) {
        // under the lock, so that whoever is about to sleep has not looked just before
        const std::lock_guard<std::mutex> lock(mutex);
        done.notify_one();
      }
    }
  }
};

}  // namespace pop
