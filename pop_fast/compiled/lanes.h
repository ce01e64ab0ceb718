// Numbers side by side: 64 bytes of float or double as the compiler's own vector type (GCC and Clang, any processor).
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <new>
#include <type_traits>
#include <vector>

#ifdef __SSE2__
#include <immintrin.h>
#endif

namespace pop {

// bytes of the widest vector whose arithmetic, comparisons and selections are all instructions
#if defined(__AVX512DQ__)
constexpr int WHOLE = 64;
#elif defined(__AVX2__)
constexpr int WHOLE = 32;
#else
constexpr int WHOLE = 16;
#endif

template <class Real, int BYTES> struct Halves;
template <class Real, int BYTES, bool SPLIT> struct ChunkOf;
template <class Real, int BYTES> struct ChunkOf<Real, BYTES, false> {
  typedef Real type __attribute__((vector_size(BYTES)));
};
template <class Real, int BYTES> struct ChunkOf<Real, BYTES, true> {
  using type = Halves<Real, BYTES>;
};
// so many bytes of numbers: the compiler's own vector where it is not too wide, else two halves
template <class Real, int BYTES> using Chunk = typename ChunkOf<Real, BYTES, (BYTES > WHOLE)>::type;

template <class Real> struct Lanes;
template <> struct Lanes<float> {
  using whole = int32_t;
};
template <> struct Lanes<double> {
  using whole = int64_t;
};
template <> struct Lanes<int32_t> {
  using whole = int32_t;
};
template <> struct Lanes<int64_t> {
  using whole = int64_t;
};
template <class Real> using Whole = typename Lanes<Real>::whole;  // an integer as wide
template <class Real> using Vec = Chunk<Real, 64>;
template <class Real> using Mask = Chunk<Whole<Real>, 64>;  // such integers; as a condition -1 where true
template <class Real> constexpr int LANES = 64 / sizeof(Real);
// What is blended at once: all lanes where one register holds them, else each half, which is left out where nothing
// happens in it, and whose sums then stay in registers. What a lane adds up, and in which order, is the same.
constexpr int PIECES = WHOLE == 64 ? 1 : 2;
template <class Real> using Piece = Chunk<Real, 64 / PIECES>;
template <class Real> constexpr int PIECE_LANES = LANES<Real> / PIECES;

// A vector that the processor has no registers for. GCC compares and selects one of those number by number and keeps it
// in memory, a quarter of the speed, so that its halves are told apart here.
template <class Real, int BYTES> struct Halves {
  using Half = Chunk<Real, BYTES / 2>;
  using Truth = Chunk<Whole<Real>, BYTES>;
  using HalfTruth = Chunk<Whole<Real>, BYTES / 2>;
  Half low, high;

  Real operator[](int lane) const {
    constexpr int half = BYTES / 2 / sizeof(Real);
    return lane < half ? low[lane] : high[lane - half];
  }
  friend Halves operator-(Halves a) { return {-a.low, -a.high}; }
  friend Halves operator<<(Halves a, int n) { return {a.low << n, a.high << n}; }
#define POP_EACH_HALF(op)                                                              \
  friend Halves operator op(Halves a, Halves b) { return {a.low op b.low, a.high op b.high}; } \
  friend Halves operator op(Halves a, Real b) { return {a.low op b, a.high op b}; }            \
  friend Halves operator op(Real a, Halves b) { return {a op b.low, a op b.high}; }
  POP_EACH_HALF(+)
  POP_EACH_HALF(-)
  POP_EACH_HALF(*)
  POP_EACH_HALF(/)
  POP_EACH_HALF(&)
  POP_EACH_HALF(|)
#undef POP_EACH_HALF
#define POP_COMPARED(op)                                                                                       \
  friend Truth operator op(Halves a, Halves b) { return {HalfTruth(a.low op b.low), HalfTruth(a.high op b.high)}; } \
  friend Truth operator op(Halves a, Real b) { return {HalfTruth(a.low op b), HalfTruth(a.high op b)}; }
  POP_COMPARED(<)
  POP_COMPARED(>)
  POP_COMPARED(>=)
  POP_COMPARED(<=)
#undef POP_COMPARED
  Halves &operator+=(Halves b) { return *this = *this + b; }
  Halves &operator-=(Halves b) { return *this = *this - b; }
  Halves &operator*=(Halves b) { return *this = *this * b; }
};

// condition ? a : b in every lane
template <class M, class V> inline V select(M condition, V a, V b) {
  if constexpr (sizeof(V) <= WHOLE) {
    return condition ? a : b;
  } else {
    return {select(condition.low, a.low, b.low), select(condition.high, a.high, b.high)};
  }
}

// a b + c, a b - c and c - a b. With fused multiply-add they are rounded once: GCC fuses by itself, but where a product has two
// uses, or a sum two products, which one is fused depends on the width of the vectors. Said here, the kernels for
// AVX2 and AVX-512 have the same bits.
template <class C> inline C fma(C a, C b, C c) {
  if constexpr (sizeof(C) > WHOLE) {
    return {fma(a.low, b.low, c.low), fma(a.high, b.high, c.high)};
  } else {
    return a * b + c;
  }
}
template <class C> inline C fms(C a, C b, C c) {
  if constexpr (sizeof(C) > WHOLE) {
    return {fms(a.low, b.low, c.low), fms(a.high, b.high, c.high)};
  } else {
    return a * b - c;
  }
}
template <class C> inline C fnma(C a, C b, C c) {
  if constexpr (sizeof(C) > WHOLE) {
    return {fnma(a.low, b.low, c.low), fnma(a.high, b.high, c.high)};
  } else {
    return c - a * b;
  }
}
#ifdef __FMA__
#define POP_FUSED(Real, call, kind)                                                                                 \
  template <> inline Chunk<Real, WHOLE> fma(Chunk<Real, WHOLE> a, Chunk<Real, WHOLE> b, Chunk<Real, WHOLE> c) {      \
    return Chunk<Real, WHOLE>(call##_fmadd_##kind(a, b, c));                                                         \
  }                                                                                                                 \
  template <> inline Chunk<Real, WHOLE> fms(Chunk<Real, WHOLE> a, Chunk<Real, WHOLE> b, Chunk<Real, WHOLE> c) {      \
    return Chunk<Real, WHOLE>(call##_fmsub_##kind(a, b, c));                                                         \
  }                                                                                                                 \
  template <> inline Chunk<Real, WHOLE> fnma(Chunk<Real, WHOLE> a, Chunk<Real, WHOLE> b, Chunk<Real, WHOLE> c) {     \
    return Chunk<Real, WHOLE>(call##_fnmadd_##kind(a, b, c));                                                        \
  }
#else
#define POP_FUSED(Real, call, kind)
#endif

// a < b ? a : b and a > b ? a : b: b where one of them is not a number, as the processor's own instructions have it
template <class C> inline C least(C a, C b) {
  if constexpr (sizeof(C) > WHOLE) {
    return {least(a.low, b.low), least(a.high, b.high)};
  } else {
    return a < b ? a : b;
  }
}
template <class C> inline C most(C a, C b) {
  if constexpr (sizeof(C) > WHOLE) {
    return {most(a.low, b.low), most(a.high, b.high)};
  } else {
    return a > b ? a : b;
  }
}
#define POP_EXTREMES(Real, call, kind)                                                      \
  template <> inline Chunk<Real, WHOLE> least(Chunk<Real, WHOLE> a, Chunk<Real, WHOLE> b) { \
    return Chunk<Real, WHOLE>(call##_min_##kind(a, b));                                     \
  }                                                                                         \
  template <> inline Chunk<Real, WHOLE> most(Chunk<Real, WHOLE> a, Chunk<Real, WHOLE> b) {  \
    return Chunk<Real, WHOLE>(call##_max_##kind(a, b));                                     \
  }
#define POP_INSTRUCTIONS(call)  \
  POP_FUSED(float, call, ps)    \
  POP_FUSED(double, call, pd)   \
  POP_EXTREMES(float, call, ps) \
  POP_EXTREMES(double, call, pd)
#if defined(__AVX512DQ__)
POP_INSTRUCTIONS(_mm512)
#elif defined(__AVX2__)
POP_INSTRUCTIONS(_mm256)
#elif defined(__SSE2__)
POP_INSTRUCTIONS(_mm)
#endif
#undef POP_FUSED
#undef POP_EXTREMES
#undef POP_INSTRUCTIONS

// the same bits as numbers of another kind
template <class To, class From> inline To bits_of(From from) {
  static_assert(sizeof(To) == sizeof(From));
  if constexpr (sizeof(To) <= WHOLE) {
    To to;
    std::memcpy(&to, &from, sizeof to);
    return to;
  } else {
    return {bits_of<typename To::Half>(from.low), bits_of<typename To::Half>(from.high)};
  }
}

// the size of every lane, without its sign
template <class C> inline C size_of(C chunk) {
  using Number = std::decay_t<decltype(chunk[0])>;
  using Digits = Chunk<Whole<Number>, sizeof(C)>;
  constexpr auto digits = sizeof(Number) == 4 ? Whole<Number>(0x7fffffff) : Whole<Number>(0x7fffffffffffffff);
  return bits_of<C>(bits_of<Digits>(chunk) & digits);
}

// both halves of a chunk
template <class Real, class C> inline Halves<Real, sizeof(C)> halves_of(C chunk) {
  if constexpr (sizeof(C) <= WHOLE) {
    Halves<Real, sizeof(C)> halves;
    std::memcpy(&halves, &chunk, sizeof chunk);
    return halves;
  } else {
    return chunk;
  }
}

template <class C, class Real> inline C load_chunk(const Real *from) {
  if constexpr (sizeof(C) <= WHOLE) {
    C chunk;
    std::memcpy(&chunk, from, sizeof chunk);
    return chunk;
  } else {
    using Half = typename C::Half;
    return {load_chunk<Half>(from), load_chunk<Half>(from + sizeof(Half) / sizeof(Real))};
  }
}

template <class C, class Real> inline void store_chunk(Real *to, C chunk) {
  if constexpr (sizeof(C) <= WHOLE) {
    std::memcpy(to, &chunk, sizeof chunk);
  } else {
    store_chunk(to, chunk.low);
    store_chunk(to + sizeof(chunk.low) / sizeof(Real), chunk.high);
  }
}

// Numbers in memory that begin where a line of the cache does: loads of lanes then never lie in two lines.
template <class T> struct LineAllocator {
  using value_type = T;
  LineAllocator() = default;
  template <class U> LineAllocator(const LineAllocator<U> &) {}
  T *allocate(size_t n) { return static_cast<T *>(::operator new(n * sizeof(T), std::align_val_t(64))); }
  void deallocate(T *at, size_t) { ::operator delete(at, std::align_val_t(64)); }
  friend bool operator==(LineAllocator, LineAllocator) { return true; }
  friend bool operator!=(LineAllocator, LineAllocator) { return false; }
};
template <class T> using Numbers = std::vector<T, LineAllocator<T>>;

template <class Real> inline Vec<Real> load(const Real *from) { return load_chunk<Vec<Real>>(from); }
template <class Real> inline void store(Real *to, Vec<Real> v) { store_chunk(to, v); }
template <class Real> inline Mask<Real> load_whole(const Whole<Real> *from) { return load_chunk<Mask<Real>>(from); }
template <class Real> inline void store_whole(Whole<Real> *to, Mask<Real> v) { store_chunk(to, v); }

template <class Real> inline Vec<Real> all(Real x) { return Vec<Real>{} + x; }
template <class Real> inline Piece<Real> load_piece(const Real *from) { return load_chunk<Piece<Real>>(from); }

// whether a mask is true in any lane
template <class M> inline bool any(M mask) {
  if constexpr (sizeof(M) > WHOLE) {
    return any(mask.low | mask.high);
  } else {
#if defined(__AVX512DQ__)
    if constexpr (sizeof(M) == 64) return _mm512_movepi32_mask(__m512i(mask)) != 0;
#elif defined(__AVX2__)
    if constexpr (sizeof(M) == 32) return _mm256_movemask_epi8(__m256i(mask)) != 0;
#elif defined(__SSE2__)
    if constexpr (sizeof(M) == 16) return _mm_movemask_epi8(__m128i(mask)) != 0;
#else
    const auto rest = bits_of<Chunk<int64_t, 16>>(mask);
    return (rest[0] | rest[1]) != 0;
#endif
  }
}

// which lanes of a mask are true, the first in the lowest bit
template <class Real, class M> inline uint32_t lanes_of(M mask) {
  if constexpr (sizeof(M) > WHOLE) {
    return lanes_of<Real>(mask.low) | lanes_of<Real>(mask.high) << (sizeof(M) / 2 / sizeof(Real));
  } else {
#if defined(__AVX512DQ__)
    if constexpr (sizeof(Real) == 4) return _mm512_movepi32_mask(__m512i(mask));
    return _mm512_movepi64_mask(__m512i(mask));
#elif defined(__AVX2__)
    if constexpr (sizeof(Real) == 4) return uint32_t(_mm256_movemask_ps(__m256(mask)));
    return uint32_t(_mm256_movemask_pd(__m256d(mask)));
#elif defined(__SSE2__)
    if constexpr (sizeof(Real) == 4) return uint32_t(_mm_movemask_ps(__m128(mask)));
    return uint32_t(_mm_movemask_pd(__m128d(mask)));
#else
    uint32_t found = 0;
    for (int lane = 0; lane < int(sizeof(M) / sizeof(Real)); lane++) found |= uint32_t(mask[lane] & 1) << lane;
    return found;
#endif
  }
}

// the sum of all lanes, halves first: always in the same order
template <class Real, class C> inline Real sum(C chunk) {
  if constexpr (sizeof(C) > 16) {
    const auto halves = halves_of<Real>(chunk);
    return sum<Real>(halves.low + halves.high);
  } else if constexpr (sizeof(Real) == 8) {
    return chunk[0] + chunk[1];
  } else {
    return (chunk[0] + chunk[2]) + (chunk[1] + chunk[3]);
  }
}

// The sums of sixteen rows of lanes, each by halves as in `sum`.
template <class Real> inline void sums_of_rows(const Real *rows, Real sums[16]) {
  for (int k = 0; k < 16; k++) sums[k] = sum<Real>(load(rows + k * LANES<Real>));
}

#if defined(__AVX512DQ__) && !defined(__clang__)
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
#elif defined(__SSE2__)
// In float the halves of every row, then four rows at a time, whose lanes change places; row k ends in lane k.
template <> inline void sums_of_rows<float>(const float *rows, float sums[16]) {
  for (int k = 0; k < 16; k += 4) {
    __m128 row[4];
    for (int r = 0; r < 4; r++) {
      const float *at = rows + (k + r) * 16;
      row[r] = (_mm_loadu_ps(at) + _mm_loadu_ps(at + 8)) + (_mm_loadu_ps(at + 4) + _mm_loadu_ps(at + 12));
    }
    _MM_TRANSPOSE4_PS(row[0], row[1], row[2], row[3]);
    _mm_storeu_ps(sums + k, (row[0] + row[2]) + (row[1] + row[3]));
  }
}
#endif

// 2^e for e < 128, within a unit in the last place and exact for whole numbers; what would be subnormal is 0 or 2^-126,
// far under any alpha floor. 2^e = 2^i 2^f with |f| <= 1/2: the minimax polynomial of degree 6 is 1.9e-9 off.
template <class C> inline C exp2_of_floats(C e) {
#ifdef __AVX512DQ__
  // what is left of e after the nearest integer, and the scaling by 2^i, are instructions
  const C f = C(_mm512_reduce_ps(__m512(e), _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC));
#else
  e = most(C{} + -126.0f, e);
  const C shift = C{} + 12582912.0f;  // 1.5 * 2^23: adding it leaves the nearest integer in the low bits
  const C shifted = e + shift;
  const C f = e - (shifted - shift);
#endif
  C p = C{} + 1.53458120e-04f;
  p = p * f + 1.33999312e-03f;
  p = p * f + 9.61848896e-03f;
  p = p * f + 5.55032878e-02f;
  p = p * f + 2.40226469e-01f;
  p = p * f + 6.93147206e-01f;
  p = p * f + 1.0f;
#ifdef __AVX512DQ__
  return C(_mm512_scalef_ps(__m512(p), _mm512_roundscale_ps(__m512(e), _MM_FROUND_TO_NEAREST_INT)));
#else
  using Truth = Chunk<int32_t, sizeof(C)>;
  return bits_of<C>(bits_of<Truth>(p) + (bits_of<Truth>(shifted) << 23));
#endif
}

// 2^e in every lane of a strip or of a part of it.
template <class Real, class C> inline C exp2_of(C e) {
  if constexpr (sizeof(Real) == 4) {
    return exp2_of_floats(e);
  } else {
    double lanes[sizeof(C) / sizeof(double)];
    store_chunk(lanes, e);
    for (double &lane : lanes) lane = std::exp2(lane);
    return load_chunk<C>(lanes);
  }
}

}  // namespace pop
