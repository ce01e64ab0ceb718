// Spherical harmonics to colour; the counterpart of pop_ref/harmonics.py, whose signs and homogeneous polynomials it keeps.
#pragma once

#include "real.cuh"

namespace pop {

constexpr int MAX_BASIS = 16;

// sqrt(k / pi) of the oracle's closed forms, to more digits than a double holds
constexpr double SH_C0 = 0.282094791773878143474;
constexpr double SH_C1 = 0.488602511902919921586;
constexpr double SH_C2 = 1.09254843059207907054;
constexpr double SH_C2_Z = 0.315391565252520006031;
constexpr double SH_C3_3 = 0.590043589926643510346;
constexpr double SH_C3_2 = 2.89061144264055405539;
constexpr double SH_C3_1 = 0.457045799464465736158;
constexpr double SH_C3_0 = 0.373176332590115391414;

template <class Real>
POP_HD void basis_one(Vec3<Real> dir, int degree, Real basis[MAX_BASIS]) {
    const Real C0 = Real(SH_C0), C1 = Real(SH_C1), C2 = Real(SH_C2), C2_Z = Real(SH_C2_Z), C3_3 = Real(SH_C3_3),
               C3_2 = Real(SH_C3_2), C3_1 = Real(SH_C3_1), C3_0 = Real(SH_C3_0);
    const Real x = dir.x, y = dir.y, z = dir.z;
    const Real xx = x * x, yy = y * y, zz = z * z, two = Real(2), three = Real(3), four = Real(4);
    POP_UNROLL
    for (int k = 0; k < MAX_BASIS; ++k) basis[k] = Real(0);
    basis[0] = C0;
    if (degree < 1) return;
    basis[1] = -C1 * y;
    basis[2] = C1 * z;
    basis[3] = -C1 * x;
    if (degree < 2) return;
    basis[4] = C2 * x * y;
    basis[5] = -C2 * y * z;
    basis[6] = C2_Z * (two * zz - xx - yy);
    basis[7] = -C2 * x * z;
    basis[8] = C2 / two * (xx - yy);
    if (degree < 3) return;
    basis[9] = -C3_3 * y * (three * xx - yy);
    basis[10] = C3_2 * x * y * z;
    basis[11] = -C3_1 * y * (four * zz - xx - yy);
    basis[12] = C3_0 * z * (two * zz - three * xx - three * yy);
    basis[13] = -C3_1 * x * (four * zz - xx - yy);
    basis[14] = C3_2 / two * z * (xx - yy);
    basis[15] = -C3_3 * x * (xx - three * yy);
}

// v_dir = sum_k v_basis_k grad Y_k, the gradients of the oracle's table taken together
template <class Real>
POP_HD Vec3<Real> basis_one_vjp(Vec3<Real> dir, int degree, const Real v[MAX_BASIS]) {
    const Real C1 = Real(SH_C1), C2 = Real(SH_C2), C2_Z = Real(SH_C2_Z), C3_3 = Real(SH_C3_3), C3_2 = Real(SH_C3_2),
               C3_1 = Real(SH_C3_1), C3_0 = Real(SH_C3_0);
    const Real x = dir.x, y = dir.y, z = dir.z;
    const Real xx = x * x, yy = y * y, zz = z * z, two = Real(2), three = Real(3), four = Real(4), six = Real(6);
    Vec3<Real> v_dir = {Real(0), Real(0), Real(0)};
    if (degree < 1) return v_dir;
    v_dir = {-C1 * v[3], -C1 * v[1], C1 * v[2]};
    if (degree < 2) return v_dir;
    v_dir.x += C2 * y * v[4] - two * C2_Z * x * v[6] - C2 * z * v[7] + C2 * x * v[8];
    v_dir.y += C2 * x * v[4] - C2 * z * v[5] - two * C2_Z * y * v[6] - C2 * y * v[8];
    v_dir.z += -C2 * y * v[5] + four * C2_Z * z * v[6] - C2 * x * v[7];
    if (degree < 3) return v_dir;
    v_dir.x += -six * C3_3 * x * y * v[9] + C3_2 * y * z * v[10] + two * C3_1 * x * y * v[11];
    v_dir.y += -three * C3_3 * (xx - yy) * v[9] + C3_2 * x * z * v[10] - C3_1 * (four * zz - xx - three * yy) * v[11];
    v_dir.z += C3_2 * x * y * v[10] - Real(8) * C3_1 * y * z * v[11];
    v_dir.x += -six * C3_0 * x * z * v[12] - C3_1 * (four * zz - three * xx - yy) * v[13] + C3_2 * x * z * v[14];
    v_dir.y += -six * C3_0 * y * z * v[12] + two * C3_1 * x * y * v[13] - C3_2 * y * z * v[14];
    v_dir.z += three * C3_0 * (two * zz - xx - yy) * v[12] - Real(8) * C3_1 * x * z * v[13];
    v_dir.x += -three * C3_3 * (xx - yy) * v[15];
    v_dir.y += six * C3_3 * x * y * v[15];
    v_dir.z += C3_2 / two * (xx - yy) * v[14];
    return v_dir;
}

template <class Real>
POP_HD Real dir_norm(Vec3<Real> d) {
    const Real largest = max_of(max_of(Real(fabs(d.x)), Real(fabs(d.y))), Real(fabs(d.z)));
    const Real x = d.x / largest, y = d.y / largest, z = d.z / largest;
    return largest * sqrt(x * x + y * y + z * z);
}

template <class Real>
POP_HD Vec3<Real> unit_dir(Vec3<Real> d) {
    const Real norm = dir_norm(d);
    return {d.x / norm, d.y / norm, d.z / norm};
}

// coefficients of one Gaussian: [n_sh, 3] in one piece, or the first band and the rest apart as trainers keep them
template <class Real>
struct ShRow {
    const Real* first;
    const Real* rest;
    POP_HD Vec3<Real> at(int k) const {
        const Real* row = k == 0 ? first : rest + 3 * (k - 1);
        return {row[0], row[1], row[2]};
    }
};

// `Row` is a ShRow, or what a kernel has instead, with the same `at`
template <class Real, class Row>
POP_HD Vec3<Real> unclamped_color(const Row& sh, const Real basis[MAX_BASIS], int n_sh) {
    Vec3<Real> color = {Real(0), Real(0), Real(0)};
    POP_UNROLL
    for (int k = 0; k < MAX_BASIS; ++k) {
        if (k >= n_sh) break;
        const Vec3<Real> row = sh.at(k);
        color.x += basis[k] * row.x;
        color.y += basis[k] * row.y;
        color.z += basis[k] * row.z;
    }
    const Real half = Real(0.5);
    return {color.x + half, color.y + half, color.z + half};
}

// B2: clamped at 0
template <class Real, class Row>
POP_HD Vec3<Real> color_from_basis(const Row& sh, const Real basis[MAX_BASIS], int n_sh) {
    const Vec3<Real> unclamped = unclamped_color(sh, basis, n_sh);
    return {max_of(unclamped.x, Real(0)), max_of(unclamped.y, Real(0)), max_of(unclamped.z, Real(0))};
}

template <class Real, class Row>
POP_HD Vec3<Real> color_from_sh(const Row& sh, Vec3<Real> dir, int degree) {
    Real basis[MAX_BASIS];
    basis_one(unit_dir(dir), degree, basis);
    return color_from_basis(sh, basis, (degree + 1) * (degree + 1));
}

// v_sum is left to the caller: v_sh_k = basis_k v_sum is an outer product that need not be stored
template <class Real, class Row>
POP_HD void color_from_basis_vjp(const Row& sh, const Real basis[MAX_BASIS], int n_sh, Vec3<Real> v_color,
                                 Vec3<Real>& v_sum, Real v_basis[MAX_BASIS]) {
    const Vec3<Real> unclamped = unclamped_color(sh, basis, n_sh);
    // B2: a channel under 0 passes nothing; at exactly 0 the derivative from above is used
    v_sum = {unclamped.x >= Real(0) ? v_color.x : Real(0), unclamped.y >= Real(0) ? v_color.y : Real(0),
             unclamped.z >= Real(0) ? v_color.z : Real(0)};
    POP_UNROLL
    for (int k = 0; k < MAX_BASIS; ++k) v_basis[k] = k < n_sh ? dot(sh.at(k), v_sum) : Real(0);
}

// the transpose of basis_one(unit_dir(dir)), of which u is the direction
template <class Real>
POP_HD Vec3<Real> basis_of_dir_vjp(Vec3<Real> dir, Vec3<Real> u, int degree, const Real v_basis[MAX_BASIS]) {
    const Vec3<Real> v_u = basis_one_vjp(u, degree, v_basis);
    const Real along = dot(u, v_u), norm = dir_norm(dir);
    return {(v_u.x - u.x * along) / norm, (v_u.y - u.y * along) / norm, (v_u.z - u.z * along) / norm};
}

// basis and v_sum are left to the caller, as above
template <class Real, class Row>
POP_HD Vec3<Real> color_from_sh_vjp(const Row& sh, Vec3<Real> dir, int degree, Vec3<Real> v_color,
                                    Real basis[MAX_BASIS], Vec3<Real>& v_sum) {
    const Vec3<Real> u = unit_dir(dir);
    Real v_basis[MAX_BASIS];
    basis_one(u, degree, basis);
    color_from_basis_vjp(sh, basis, (degree + 1) * (degree + 1), v_color, v_sum, v_basis);
    return basis_of_dir_vjp(dir, u, degree, v_basis);
}

}  // namespace pop
