// Density control of one row; the counterpart of pop_ref/density.py and density_rows.py.
#pragma once

#include "activations.cuh"
#include "covariance.cuh"

namespace pop {

// the screen gradient in NDC units that density control compares
template <class Real>
POP_HD Real densification_gradient(Vec2<Real> v_mean2d, int width, int height) {
    const Real x = Real(0.5) * Real(width) * v_mean2d.x, y = Real(0.5) * Real(height) * v_mean2d.y;
    return sqrt(x * x + y * y);
}

template <class Real>
struct Child {
    Vec3<Real> mean, log_scale;
};

// a child of a split: drawn from its parent with the normal numbers given, and shrunk
template <class Real>
POP_HD Child<Real> split_one(Vec3<Real> mean, Vec4<Real> quat, Vec3<Real> log_scale, Vec3<Real> normal, Real shrink) {
    const Vec3<Real> s = scale_from_log_scale(log_scale);
    const Vec3<Real> offset = times(rotmat_from_quat(quat), Vec3<Real>{s.x * normal.x, s.y * normal.y, s.z * normal.z});
    const Real less = log(shrink);
    return {sum(mean, offset), {log_scale.x - less, log_scale.y - less, log_scale.z - less}};
}

}  // namespace pop
