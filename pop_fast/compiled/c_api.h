// How a stage is entered from Python: one function a precision, which says whether it ran to its end.
#pragma once

#include "threads.h"

// Whether it ran to its end: what throws here is out of memory, and an exception must not leave C.
template <class F> int ran(F f) noexcept {
  try {
    f();
    return 1;
  } catch (...) {
    return 0;
  }
}

#define POP_STAGE(name, Layout, function)                                        \
  int pop_##name##_float32(const pop::Layout<float> *given, pop::Fork fork) {    \
    return ran([&] { pop::function(*given, fork); });                            \
  }                                                                              \
  int pop_##name##_float64(const pop::Layout<double> *given, pop::Fork fork) {   \
    return ran([&] { pop::function(*given, fork); });                            \
  }
