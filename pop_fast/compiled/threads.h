// Work shared out to threads.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <thread>
#include <vector>

namespace pop {

// GOMP_parallel of the OpenMP runtime that torch brought along: its threads are awake already. Null elsewhere.
using Fork = void (*)(void (*)(void *), void *, unsigned, unsigned);

template <class Work> void on_all_threads(Fork fork, int64_t threads, Work work) {
  const auto call = [](void *given) { (*static_cast<Work *>(given))(); };
  if (threads <= 1) {
    work();
  } else if (fork) {
    fork(call, &work, unsigned(threads), 0);
  } else {
    std::vector<std::thread> others;
    for (int64_t k = 1; k < threads; k++) others.emplace_back(call, &work);
    work();
    for (auto &other : others) other.join();
  }
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
