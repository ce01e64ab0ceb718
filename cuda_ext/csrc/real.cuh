// Numbers, small vectors and small matrices, for host and device, over Real = float or double.
//
// mul, add and fma round once each and are never contracted, so that the forward and the backward kernel compute the
// same bits of alpha from the same splat.
#pragma once

#include <math.h>
#include <string.h>

#ifdef __CUDACC__
#define POP_HD __host__ __device__ __forceinline__
#define POP_UNROLL _Pragma("unroll")
#else
#define POP_HD inline
#define POP_UNROLL
#endif

namespace pop {

template <class Real>
struct Vec2 {
    Real x, y;
};

template <class Real>
struct Vec3 {
    Real x, y, z;
};

template <class Real>
struct Vec4 {
    Real w, x, y, z;
};

template <class Real>
struct Mat2 {
    Real m[2][2];
};

template <class Real>
struct Mat23 {
    Real m[2][3];
};

template <class Real>
struct Mat3 {
    Real m[3][3];
};

template <class Real>
POP_HD Real min_of(Real a, Real b) {
    return b < a ? b : a;
}

// the same, one instruction on the device; not for code that a CPU's vectors are made of
POP_HD float least(float a, float b) { return fminf(a, b); }
POP_HD double least(double a, double b) { return fmin(a, b); }
POP_HD float most(float a, float b) { return fmaxf(a, b); }
POP_HD double most(double a, double b) { return fmax(a, b); }

template <class Real>
POP_HD Real max_of(Real a, Real b) {
    return a < b ? b : a;
}

template <class Real>
POP_HD Real clamped(Real value, Real low, Real high) {
    return min_of(max_of(value, low), high);
}

POP_HD float mul(float a, float b) {
#ifdef __CUDA_ARCH__
    return __fmul_rn(a, b);
#else
    return a * b;
#endif
}

POP_HD double mul(double a, double b) { return a * b; }

POP_HD float add(float a, float b) {
#ifdef __CUDA_ARCH__
    return __fadd_rn(a, b);
#else
    return a + b;
#endif
}

POP_HD double add(double a, double b) { return a + b; }

POP_HD float fused(float a, float b, float c) {
#ifdef __CUDA_ARCH__
    return __fmaf_rn(a, b, c);
#else
    return fmaf(a, b, c);
#endif
}

POP_HD double fused(double a, double b, double c) { return fma(a, b, c); }

// 2^x; on the device one instruction of the special function unit, within 2 ulp
POP_HD float power_of_two(float x) {
#ifdef __CUDA_ARCH__
    float y;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#else
    return exp2f(x);
#endif
}

POP_HD double power_of_two(double x) { return exp2(x); }

// 1 / x; on the device one instruction, within 1 ulp
POP_HD float reciprocal(float x) {
#ifdef __CUDA_ARCH__
    float y;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#else
    return 1.0f / x;
#endif
}

POP_HD double reciprocal(double x) { return 1.0 / x; }

// a / b where |b| is below 2^126; on the device two instructions, within 2 ulp, where the rounded quotient takes ten and a
// call of a subroutine for a numerator of 0
POP_HD float quotient(float a, float b) {
#ifdef __CUDA_ARCH__
    return a * reciprocal(b);
#else
    return a / b;
#endif
}

POP_HD double quotient(double a, double b) { return a / b; }

// the root of x >= 0; on the device one instruction, within 2 ulp, and 0 below 2^-126
POP_HD float square_root(float x) {
#ifdef __CUDA_ARCH__
    float y;
    asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#else
    return sqrtf(x);
#endif
}

POP_HD double square_root(double x) { return sqrt(x); }

// a float's bits: of two that are not negative the larger has the larger bits, and negative ones and NaN have larger
// bits than any number that is neither
POP_HD unsigned bits_of(float x) {
#ifdef __CUDA_ARCH__
    return __float_as_uint(x);
#else
    unsigned bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
#endif
}

// a > b and also; on the device one comparison, where the compiler makes two of it
POP_HD bool larger_and(float a, float b, bool also) {
#ifdef __CUDA_ARCH__
    int found;
    asm("{ .reg .pred p, q; setp.ne.s32 q, %3, 0; setp.gt.and.f32 p, %1, %2, q; selp.s32 %0, 1, 0, p; }"
        : "=r"(found) : "f"(a), "f"(b), "r"(int(also)));
    return found != 0;
#else
    return (a > b) & also;
#endif
}
POP_HD bool larger_and(double a, double b, bool also) { return (a > b) & also; }

// 0 <= x < limit, for limit >= 0; not for a NaN. For floats one comparison.
POP_HD bool within(float x, float limit) { return bits_of(x) < bits_of(limit); }
POP_HD bool within(double x, double limit) { return x >= 0.0 && x < limit; }

template <class Real>
POP_HD Real dot(Vec3<Real> a, Vec3<Real> b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

template <class Real>
POP_HD Vec3<Real> sum(Vec3<Real> a, Vec3<Real> b) {
    return {a.x + b.x, a.y + b.y, a.z + b.z};
}

template <class Real>
POP_HD Vec3<Real> times(Mat3<Real> a, Vec3<Real> v) {
    return {a.m[0][0] * v.x + a.m[0][1] * v.y + a.m[0][2] * v.z, a.m[1][0] * v.x + a.m[1][1] * v.y + a.m[1][2] * v.z,
            a.m[2][0] * v.x + a.m[2][1] * v.y + a.m[2][2] * v.z};
}

template <class Real>
POP_HD Mat3<Real> transposed(Mat3<Real> a) {
    Mat3<Real> t;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) t.m[i][j] = a.m[j][i];
    return t;
}

template <class Real>
POP_HD Mat3<Real> times(Mat3<Real> a, Mat3<Real> b) {
    Mat3<Real> c;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) c.m[i][j] = a.m[i][0] * b.m[0][j] + a.m[i][1] * b.m[1][j] + a.m[i][2] * b.m[2][j];
    return c;
}

template <class Real>
POP_HD Mat23<Real> times(Mat23<Real> a, Mat3<Real> b) {
    Mat23<Real> c;
    for (int i = 0; i < 2; ++i)
        for (int j = 0; j < 3; ++j) c.m[i][j] = a.m[i][0] * b.m[0][j] + a.m[i][1] * b.m[1][j] + a.m[i][2] * b.m[2][j];
    return c;
}

template <class Real>
POP_HD Mat3<Real> outer(Vec3<Real> a, Vec3<Real> b) {
    return {{{a.x * b.x, a.x * b.y, a.x * b.z}, {a.y * b.x, a.y * b.y, a.y * b.z}, {a.z * b.x, a.z * b.y, a.z * b.z}}};
}

template <class Real>
POP_HD Mat3<Real> sum(Mat3<Real> a, Mat3<Real> b) {
    Mat3<Real> c;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) c.m[i][j] = a.m[i][j] + b.m[i][j];
    return c;
}

}  // namespace pop
