// Raw parameters to what the renderer uses; the counterpart of pop_ref/activations.py.
#pragma once

#include "real.cuh"

namespace pop {

template <class Real>
POP_HD Vec3<Real> scale_from_log_scale(Vec3<Real> log_scale) {
    return {exp(log_scale.x), exp(log_scale.y), exp(log_scale.z)};
}

template <class Real>
POP_HD Vec3<Real> scale_from_log_scale_vjp(Vec3<Real> log_scale, Vec3<Real> v_scale) {
    const Vec3<Real> scale = scale_from_log_scale(log_scale);
    return {scale.x * v_scale.x, scale.y * v_scale.y, scale.z * v_scale.z};
}

template <class Real>
POP_HD Real opacity_from_logit(Real logit) {
    // the exponent is never positive, so that exp cannot overflow
    const Real fall = exp(-fabs(logit));
    return (logit >= Real(0) ? Real(1) : fall) / (Real(1) + fall);
}

template <class Real>
POP_HD Real opacity_from_logit_vjp(Real logit, Real v_opacity) {
    // 1 - o is the opacity of the negated logit: no cancellation where o is near 1
    return opacity_from_logit(logit) * opacity_from_logit(-logit) * v_opacity;
}

template <class Real>
POP_HD Real quat_norm(Vec4<Real> q) {
    // divided by the largest entry first: squares of any representable quaternion neither overflow nor vanish
    const Real largest = max_of(max_of(Real(fabs(q.w)), Real(fabs(q.x))), max_of(Real(fabs(q.y)), Real(fabs(q.z))));
    const Real w = q.w / largest, x = q.x / largest, y = q.y / largest, z = q.z / largest;
    return largest * sqrt(w * w + x * x + y * y + z * z);
}

template <class Real>
POP_HD Vec4<Real> unit_quat_from_quat(Vec4<Real> q) {
    const Real norm = quat_norm(q);
    return {q.w / norm, q.x / norm, q.y / norm, q.z / norm};
}

}  // namespace pop
