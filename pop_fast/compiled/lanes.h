// Numbers side by side: 64 bytes of float or double as the compiler's own vector type (GCC and Clang, any processor).
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#ifdef __AVX512DQ__
#include <immintrin.h>
#endif

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

// which lanes of a mask are true, the first in the lowest bit
template <class Real> inline uint32_t lanes_of(Mask<Real> mask) {
#ifdef __AVX512DQ__
  if constexpr (sizeof(Real) == 4) {
    return _mm512_movepi32_mask(__m512i(mask));
  } else {
    return _mm512_movepi64_mask(__m512i(mask));
  }
#else
  uint32_t found = 0;
  for (int lane = 0; lane < LANES<Real>; lane++) found |= uint32_t(mask[lane] & 1) << lane;
  return found;
#endif
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

// The sums of sixteen rows of lanes, each by halves as in `sum`.
template <class Real> inline void sums_of_rows(const Real *rows, Real sums[16]) {
  for (int k = 0; k < 16; k++) sums[k] = sum<Real>(load(rows + k * LANES<Real>));
}

#if defined(__GNUC__) && !defined(__clang__)
// In float four rounds, each of which adds the halves of two vectors into one; row k ends in lane k.
template <> inline void sums_of_rows<float>(const float *rows, float sums[16]) {
  using V = Vec<float>;
  using M = Mask<float>;
  V v[16];
  for (int k = 0; k < 16; k++) v[k] = load(rows + k * 16);
  // pairs are chosen such that the halves of later rounds fall into place: k with k + 8, then + 4, + 2, + 1
  for (int k = 0; k < 8; k++)
    v[k] = __builtin_shuffle(v[k], v[k + 8], M{0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23}) +
           __builtin_shuffle(v[k], v[k + 8], M{8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31});
  for (int k = 0; k < 4; k++)
    v[k] = __builtin_shuffle(v[k], v[k + 4], M{0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27}) +
           __builtin_shuffle(v[k], v[k + 4], M{4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31});
  for (int k = 0; k < 2; k++)
    v[k] = __builtin_shuffle(v[k], v[k + 2], M{0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29}) +
           __builtin_shuffle(v[k], v[k + 2], M{2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31});
  store(sums, __builtin_shuffle(v[0], v[1], M{0, 16, 2, 18, 4, 20, 6, 22, 8, 24, 10, 26, 12, 28, 14, 30}) +
                  __builtin_shuffle(v[0], v[1], M{1, 17, 3, 19, 5, 21, 7, 23, 9, 25, 11, 27, 13, 29, 15, 31}));
}
#endif

// 2^e for e < 128, within a unit in the last place and exact for whole numbers; what would be subnormal is 0 or 2^-126,
// far under any alpha floor. 2^e = 2^i 2^f with |f| <= 1/2: the minimax polynomial of degree 6 is 1.9e-9 off.
inline Vec<float> exp2_of(Vec<float> e) {
#ifdef __AVX512DQ__
  // what is left of e beside the nearest integer, and the scaling by 2^i, are instructions
  const Vec<float> f = Vec<float>(_mm512_reduce_ps(__m512(e), _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC));
#else
  e = e < -126.0f ? all(-126.0f) : e;
  const Vec<float> shift = all(12582912.0f);  // 1.5 * 2^23: adding it leaves the nearest integer in the low bits
  const Vec<float> shifted = e + shift;
  const Vec<float> f = e - (shifted - shift);
#endif
  Vec<float> p = all(1.53458120e-04f);
  p = p * f + 1.33999312e-03f;
  p = p * f + 9.61848896e-03f;
  p = p * f + 5.55032878e-02f;
  p = p * f + 2.40226469e-01f;
  p = p * f + 6.93147206e-01f;
  p = p * f + 1.0f;
#ifdef __AVX512DQ__
  return Vec<float>(_mm512_scalef_ps(__m512(p), _mm512_roundscale_ps(__m512(e), _MM_FROUND_TO_NEAREST_INT)));
#else
  return bits_of<Vec<float>>(bits_of<Mask<float>>(p) + (bits_of<Mask<float>>(shifted) << 23));
#endif
}

inline Vec<double> exp2_of(Vec<double> e) {
  for (int lane = 0; lane < LANES<double>; lane++) e[lane] = std::exp2(e[lane]);
  return e;
}

}  // namespace pop
