// The pull of the polarized opacity prior; beside pop_ref/polarization.py.
#pragma once

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

}  // namespace pop
