// The pull of the polarized opacity prior, and of the entropy that is its rival; the counterpart of pop_ref/polarization.py.
#pragma once

#include "activations.cuh"
#include "real.cuh"

namespace pop {

// where a Gaussian stands in the POP term: nowhere, pulled to 1, or pushed to 0
enum class PopSide : unsigned char { absent = 0, important = 1, other = 2 };

// cotangent of an activated opacity: -v / N_imp where important, +v / (N - N_imp) for the others
template <class Real>
POP_HD Real pop_loss_vjp_one(PopSide side, int n_important, int n_others, Real v_loss) {
    if (side == PopSide::absent) return Real(0);
    return side == PopSide::important ? -v_loss / Real(max_of(n_important, 1)) : v_loss / Real(max_of(n_others, 1));
}

// o ln(1 + e^-x) + (1 - o) ln(1 + e^x), the entropy of an opacity by its logit x
template <class Real>
POP_HD Real opacity_entropy_one(Real logit) {
    // of both softplus the exponent is never positive; they differ by |x|
    const Real least = log1p(exp(-fabs(logit)));
    const Real more = least + fabs(logit);
    const bool over = logit >= Real(0);
    return opacity_from_logit(logit) * (over ? least : more) + opacity_from_logit(-logit) * (over ? more : least);
}

// cotangent of a logit: -v x o (1 - o), v that of the mean over the number of Gaussians
template <class Real>
POP_HD Real opacity_entropy_vjp_one(Real logit, Real v_each) {
    return -v_each * logit * opacity_from_logit(logit) * opacity_from_logit(-logit);
}

}  // namespace pop
