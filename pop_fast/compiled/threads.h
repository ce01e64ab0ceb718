// Work shared out to threads.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <new>
#include <thread>
#include <vector>

namespace pop {

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

}  // namespace pop
