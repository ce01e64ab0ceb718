"""The laws over the host mirror, of the stages that are mathematics of the kernels."""

from __future__ import annotations

from tests.judged import law_classes

MODULES = (
    *("activations", "agreement", "alpha", "camera", "compositing", "covariance", "dominance", "footprint"),
    *("gradients", "harmonics", "optimizer", "projection", "whole"),
)
globals().update(law_classes(MODULES))
