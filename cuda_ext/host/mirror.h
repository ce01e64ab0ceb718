// How arrays cross into the host mirror; pop_ref/conformance/mirror_library.py has the same struct.
#pragma once

#include "../csrc/camera.cuh"
#include "../csrc/footprint.cuh"

namespace pop {
namespace mirror {

constexpr int N_ARRAYS = 12;

template <class Real>
struct Arguments {
    const Real* in[N_ARRAYS];
    Real* out[N_ARRAYS];
    long long* ids[N_ARRAYS];
    long long n;
    int integers[N_ARRAYS];
    Real numbers[N_ARRAYS];
    Profile<Real> profile;
};

template <class Real>
struct Entry {
    const char* name;
    void (*run)(Arguments<Real>&);
};

template <class Real>
Vec2<Real> vec2(const Real* p, long long i) {
    return {p[2 * i], p[2 * i + 1]};
}

template <class Real>
Vec3<Real> vec3(const Real* p, long long i) {
    return {p[3 * i], p[3 * i + 1], p[3 * i + 2]};
}

template <class Real>
Vec4<Real> vec4(const Real* p, long long i) {
    return {p[4 * i], p[4 * i + 1], p[4 * i + 2], p[4 * i + 3]};
}

template <class Real>
Conic<Real> conic(const Real* p, long long i) {
    return {p[3 * i], p[3 * i + 1], p[3 * i + 2]};
}

template <class Matrix, class Real>
Matrix matrix(const Real* p, long long i) {
    Matrix a;
    Real* entries = &a.m[0][0];
    constexpr int n = int(sizeof(Matrix) / sizeof(Real));
    for (int k = 0; k < n; ++k) entries[k] = p[n * i + k];
    return a;
}

// writes a struct of Reals as row i
template <class Struct, class Real>
void put(Real* p, long long i, const Struct& value) {
    constexpr int n = int(sizeof(Struct) / sizeof(Real));
    const Real* entries = reinterpret_cast<const Real*>(&value);
    for (int k = 0; k < n; ++k) p[n * i + k] = entries[k];
}

template <class Real>
void put_viewmat(Real* p, const ViewmatVjp<Real>& v) {
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) p[4 * i + j] = v.v_R.m[i][j];
    p[3] = v.v_t.x;
    p[7] = v.v_t.y;
    p[11] = v.v_t.z;
    for (int j = 12; j < 16; ++j) p[j] = Real(0);
}

template <class Real>
ViewmatVjp<Real> zero_viewmat() {
    ViewmatVjp<Real> v = {};
    return v;
}

}  // namespace mirror
}  // namespace pop
