// Numbers side by side: 64 bytes of float or double as the compiler's own vector type (GCC and Clang, any processor).
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

namespace pop {

template <class Real> struct Lanes;
template <> struct Lanes<float> {
  using whole = int32_t;
  typedef float vec __attribute__((vector_size(64)));
  typedef int32_t mask __attribute__((vector_size(64)));
};
template <> struct Lanes<double> {
  using whole = int64_t;
  typedef double vec __attribute__((vector_size(64)));
  typedef int64_t mask __attribute__((vector_size(64)));
};
template <class Real> using Whole = typename Lanes<Real>::whole;  // an integer as wide
template <class Real> using Vec = typename Lanes<Real>::vec;
template <class Real> using Mask = typename Lanes<Real>::mask;  // such integers; as a condition -1 where true
template <class Real> constexpr int LANES = 64 / sizeof(Real);

template <class To, class From> inline To bits_of(const From &from) {
  static_assert(sizeof(To) == sizeof(From));
  To to;
  std::memcpy(&to, &from, sizeof to);
  return to;
}

template <class Real> inline Vec<Real> load(const Real *from) {
  Vec<Real> v;
  std::memcpy(&v, from, sizeof v);
  return v;
}

template <class Real> inline void store(Real *to, Vec<Real> v) { std::memcpy(to, &v, sizeof v); }

template <class Real> inline Mask<Real> load_whole(const Whole<Real> *from) {
  Mask<Real> v;
  std::memcpy(&v, from, sizeof v);
  return v;
}

template <class Real> inline void store_whole(Whole<Real> *to, Mask<Real> v) { std::memcpy(to, &v, sizeof v); }

template <class Real> inline Vec<Real> all(Real x) { return Vec<Real>{} + x; }

// whether a mask is true in any lane
template <class M> inline bool any(M mask) {
  typedef int64_t four __attribute__((vector_size(32)));
  typedef int64_t two __attribute__((vector_size(16)));
  struct Halves {
    four low, high;
  };
  struct Quarters {
    two low, high;
  };
  const Halves halves = bits_of<Halves>(mask);
  const Quarters quarters = bits_of<Quarters>(halves.low | halves.high);
  const two rest = quarters.low | quarters.high;
  return (rest[0] | rest[1]) != 0;
}

// the sum of all lanes, halves first: always in the same order
template <class Real> inline Real sum(Vec<Real> v) {
  typedef Real half __attribute__((vector_size(32)));
  typedef Real quarter __attribute__((vector_size(16)));
  struct Halves {
    half low, high;
  };
  struct Quarters {
    quarter low, high;
  };
  const Halves halves = bits_of<Halves>(v);
  const Quarters quarters = bits_of<Quarters>(halves.low + halves.high);
  const quarter rest = quarters.low + quarters.high;
  if constexpr (sizeof(Real) == 8) {
    return rest[0] + rest[1];
  } else {
    return (rest[0] + rest[2]) + (rest[1] + rest[3]);
  }
}

// 2^e for e < 128, about a unit in the last place off; what would be subnormal is 2^-126, far under any alpha floor.
// 2^e = 2^i 2^f with |f| <= 1/2: the Taylor polynomial of degree 7 leaves out (f ln 2)^8 / 8! < 6e-9.
inline Vec<float> exp2_of(Vec<float> e) {
  e = e < -126.0f ? all(-126.0f) : e;
  const Vec<float> shift = all(12582912.0f);  // 1.5 * 2^23: adding it leaves the nearest integer in the low bits
  const Vec<float> shifted = e + shift;
  const Vec<float> f = e - (shifted - shift);
  Vec<float> p = all(1.52527338e-05f);  // ln(2)^k / k!, k = 7 to 0
  p = p * f + 1.54035304e-04f;
  p = p * f + 1.33335581e-03f;
  p = p * f + 9.61812911e-03f;
  p = p * f + 5.55041087e-02f;
  p = p * f + 2.40226507e-01f;
  p = p * f + 6.93147181e-01f;
  p = p * f + 1.0f;
  return bits_of<Vec<float>>(bits_of<Mask<float>>(p) + (bits_of<Mask<float>>(shifted) << 23));
}

inline Vec<double> exp2_of(Vec<double> e) {
  for (int lane = 0; lane < LANES<double>; lane++) e[lane] = std::exp2(e[lane]);
  return e;
}

}  // namespace pop
