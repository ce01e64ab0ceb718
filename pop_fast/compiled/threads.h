// Work shared out to threads: of one call, whose threads are OpenMP's, and of a training, which has its own.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <mutex>
#include <new>
#include <thread>
#include <vector>

namespace pop {

// ---- the threads of a call

// GOMP_parallel of the OpenMP runtime that torch brought along: its threads are awake already. Null elsewhere.
using Fork = void (*)(void (*)(void *), void *, unsigned, unsigned);

// Runs `work` on every thread; what one of them throws ends the call once all are back.
template <class Work> void on_all_threads(Fork fork, int64_t threads, Work work) {
  std::atomic<bool> failed{false};
  auto guarded = [&]() noexcept {
    try {
      work();
    } catch (...) {
      failed = true;
    }
  };
  using Guarded = decltype(guarded);
  const auto call = [](void *given) { (*static_cast<Guarded *>(given))(); };
  if (threads <= 1) {
    guarded();
  } else if (fork) {
    fork(call, &guarded, unsigned(threads), 0);
  } else {
    std::vector<std::thread> others;
    try {
      for (int64_t k = 1; k < threads; k++) others.emplace_back(call, &guarded);
    } catch (...) {
      // the system has no more threads: those that there are share the work
    }
    guarded();
    for (auto &other : others) other.join();
  }
  if (failed) throw std::bad_alloc();
}

// Call f(first, last) for parts of n until none is left; `make()` is what a thread works with.
template <class Make, class F> void share(Fork fork, int64_t threads, int64_t n, int64_t part, Make make, F f) {
  std::atomic<int64_t> next{0};
  on_all_threads(fork, threads, [&] {
    auto own = make();
    for (int64_t first; (first = next.fetch_add(part)) < n;) f(own, first, std::min(n, first + part));
  });
}

// The same for work that needs nothing of its own: f(first, last).
template <class F> void share(Fork fork, int64_t threads, int64_t n, int64_t part, F f) {
  share(fork, threads, n, part, [] { return 0; }, [&](int, int64_t first, int64_t last) { f(first, last); });
}

// ---- threads that live as long as a training and sleep between its steps
//
// A plan is a row of works, each cut into parts. Threads take part after part; whoever ends a work's last part begins
// the next work, so that no thread leads: one that the system has put aside, or not yet woken, holds up no more than the
// part it is at. A thread that has nothing to do looks for more for some microseconds, which is shorter than falling
// asleep and being woken, and then sleeps: it takes no processor from whoever else needs one.

// f(thread, first, last) for every part of n.
struct Work {
  int64_t n = 0, part = 1;
  std::function<void(int, int64_t, int64_t)> f;

  int64_t parts() const { return (n + part - 1) / part; }
  void do_part(int thread, int64_t index) const { f(thread, index * part, std::min(n, (index + 1) * part)); }
};

// What is done with one work after the other.
class Plan {
public:
  virtual ~Plan() = default;
  // Do what must be done by one thread alone, and say what can be shared next; false when there is no more.
  virtual bool next(Work &work) = 0;
  // Whether parts need not be done any more. While it holds, `next` must return false.
  virtual bool abandoned() const { return false; }
};

// Where a caller keeps what the parts of a plan's works took, in pairs: 0 and the seconds between two works, which one
// thread has for itself, or 1 and the seconds of a part.
struct Trace {
  double *pairs = nullptr;
  int64_t most = 0, n = 0;  // pairs that have room, pairs that there are
};

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
    }
    changed.notify_all();
    for (auto &other : others) other.join();
  }

  int64_t size() const { return int64_t(others.size()) + 1; }

  // Do all works of a plan; what is thrown by one ends the call once no thread works on it.
  void run(Plan &given) {
    if (trace.pairs) return run_alone(given);
    plan = &given;
    failed = ended = false;
    begin_next();
    while (!ended) {
      take_parts(0);
      wait_for([&] { return ended.load() || untaken.load() > 0; });
    }
    if (failed) throw std::bad_alloc();
  }

  // While it has a place, the caller's thread does all parts, cut as they are for all threads.
  Trace trace;

private:
  std::vector<std::thread> others;
  std::mutex mutex;
  std::condition_variable changed;
  // whoever takes one off the parts that nobody has taken may read what the work is: that stays until all are done
  std::atomic<int64_t> untaken{0}, undone{0};
  std::atomic<bool> failed{false}, ended{false}, closed{false};
  Plan *plan = nullptr;
  Work work;

  void run_alone(Plan &given) {
    using Clock = std::chrono::steady_clock;
    const auto note = [&](double kind, Clock::time_point since) {
      if (trace.n == trace.most) return;
      trace.pairs[2 * trace.n] = kind;
      trace.pairs[2 * trace.n++ + 1] = std::chrono::duration<double>(Clock::now() - since).count();
    };
    for (;;) {
      Work alone;
      auto since = Clock::now();
      const bool more = given.next(alone);
      note(0.0, since);
      if (!more) return;
      for (int64_t k = 0; k < alone.parts(); k++) {
        since = Clock::now();
        alone.do_part(0, k);
        note(1.0, since);
      }
    }
  }

  // By one thread at a time: whoever ended the last part, or the caller at the start.
  void begin_next() {
    bool more = false;
    try {
      do more = !failed && plan->next(work);
      while (more && work.parts() == 0);
    } catch (...) {
      failed = true;
      more = false;
    }
    if (more) undone = work.parts();
    {
      // under the lock, so that whoever is about to sleep has not looked just before
      const std::lock_guard<std::mutex> lock(mutex);
      if (more) {
        untaken = work.parts();
      } else {
        ended = true;
      }
    }
    if (!others.empty()) changed.notify_all();
  }

  // What a thread knows of how it gets along with others.
  struct Turn {
    using Clock = std::chrono::steady_clock;
    Clock::time_point last = Clock::now(), since = last, crowded_until = last;

    // Between two parts. On a crowded machine a thread that stays until its turn is over is put aside in the middle of a
    // part, for which all others then wait; one that lets go a little before keeps its share and holds up nobody.
    void between_parts() {
      const auto now = Clock::now();
      if (now - last > std::chrono::milliseconds(2)) {
        crowded_until = now + std::chrono::seconds(1);
        since = now;
      }
      last = now;
      if (now > crowded_until || now - since < std::chrono::microseconds(1000)) return;
      std::this_thread::sleep_for(std::chrono::microseconds(1));
      last = since = Clock::now();
    }
  };

  void take_parts(int thread) {
    static thread_local Turn turn;
    turn.last = turn.since = Turn::Clock::now();
    for (int64_t left = untaken.load(); left > 0;) {
      if (!untaken.compare_exchange_weak(left, left - 1)) continue;
      try {
        if (!plan->abandoned()) work.do_part(thread, work.parts() - left);
      } catch (...) {
        failed = true;
      }
      if (undone.fetch_sub(1) == 1) begin_next();
      turn.between_parts();
      left = untaken.load();
    }
  }

  void work_until_closed(int thread) {
    while (!closed) {
      wait_for([&] { return closed.load() || untaken.load() > 0; });
      take_parts(thread);
    }
  }

  static void pause() {
#if defined(__x86_64__) || defined(__i386__)
    __builtin_ia32_pause();
#endif
  }

  template <class Condition> void wait_for(Condition holds) {
    for (int look = 0; look < 600; look++) {
      if (holds()) return;
      pause();
    }
    std::unique_lock<std::mutex> lock(mutex);
    changed.wait(lock, holds);
  }
};

}  // namespace pop
