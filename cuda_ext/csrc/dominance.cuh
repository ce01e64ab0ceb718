// Which Gaussian a pixel belongs to; the counterpart of pop_ref/dominance.py.
#pragma once

#include "real.cuh"

namespace pop {

template <class Real>
struct Dominant {
    int id;
    Real weight;
};

template <class Real>
POP_HD Dominant<Real> no_dominant() {
    return {-1, Real(0)};
}

// D8: front to back, a later splat must be strictly larger; one that is not blended does not take part
template <class Real>
POP_HD void compete(Dominant<Real>& best, int id, Real weight, bool blended = true) {
    const bool wins = larger_and(weight, best.weight, blended);
    best = {wins ? id : best.id, wins ? weight : best.weight};
}

}  // namespace pop
