// The pull of the polarized opacity prior; beside pop_ref/polarization.py.
#pragma once

#include "real.cuh"

namespace pop {

// cotangent of an activated opacity: -v / N_imp where important, +v / (N - N_imp) elsewhere
template <class Real>
POP_HD Real pop_loss_vjp_one(bool important, int n_important, int n, Real v_loss) {
    return important ? -v_loss / Real(max_of(n_important, 1)) : v_loss / Real(max_of(n - n_important, 1));
}

}  // namespace pop
