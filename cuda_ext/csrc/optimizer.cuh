// Adam on one number; the counterpart of pop_ref/optimizer.py.
#pragma once

#include "real.cuh"

namespace pop {

// what one update's numbers share, made once a step and a parameter
template <class Real>
struct AdamStep {
    Real rate;        // lr / (1 - beta1^t)
    Real root;        // 1 / sqrt(1 - beta2^t)
    Real beta1_rest;  // 1 - beta1
    Real beta2, beta2_rest;
    Real eps;
};

// in double whatever Real is: 1 - beta2^t loses digits in float. No update has the number 0: it is one that leaves
// numbers and moments as they are
template <class Real>
POP_HD AdamStep<Real> adam_step_at(int step, double lr, double beta1, double beta2, double eps) {
    if (step == 0) return {Real(0), Real(1), Real(0), Real(1), Real(0), Real(eps)};
    const double first = 1.0 - pow(beta1, double(step)), second = 1.0 - pow(beta2, double(step));
    return {Real(lr / first), Real(1.0 / sqrt(second)), Real(1.0 - beta1), Real(beta2), Real(1.0 - beta2), Real(eps)};
}

template <class Real>
POP_HD void adam_one(Real& param, Real& m, Real& v, Real g, const AdamStep<Real>& step) {
    m = m + step.beta1_rest * (g - m);
    v = step.beta2 * v + step.beta2_rest * g * g;
    const Real denominator = square_root(v) * step.root + step.eps;
    param = param - quotient(step.rate * m, denominator);
}

}  // namespace pop
