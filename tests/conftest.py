"""Hypothesis profiles, and shapes checked: under test every annotation of the oracle is held to by beartype."""

from __future__ import annotations

import os

from jaxtyping import install_import_hook

# not the innermost loops, where the check costs more than the work, and not the dataclasses, which check themselves
SHAPES_CHECKED = tuple(
    f"pop_ref.{module}"
    for module in (
        *("activations", "covariance", "harmonics", "camera", "projection", "footprint", "tiles", "compositing"),
        *("dominance", "splatting", "render", "losses", "ssim", "polarization", "density", "density_rows"),
        *("loss_magnitudes", "optimizer", "training", "margins", "extent_margins"),
    )
)
install_import_hook(SHAPES_CHECKED, "beartype.beartype")

from pop_ref.conformance.examples import load_profile  # noqa: E402  after the hook, which must see pop_ref imported

load_profile(os.environ.get("HYPOTHESIS_PROFILE", "dev"))
