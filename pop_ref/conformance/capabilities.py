"""The stages of the laws, and what an implementation may be able to do besides single stage functions.

A law that needs more than an implementation offers is skipped by name.
"""

from __future__ import annotations

from typing import Final

from pop_ref.constants import GSPLAT_1_6, INRIA, Profile

STAGES: Final = (
    "activations", "covariance", "harmonics", "camera", "projection", "footprint", "tiles", "alpha",
    "compositing", "dominance", "gradients", "whole", "losses", "polarization", "few_photographs", "density",
    "optimizer", "training", "autograd", "contributions", "sensitivity", "fisher", "chord", "selection", "taming",
    "mini_splatting", "tight_tiles", "signature",
)  # fmt: skip

RENDER: Final = "render"
GRADIENTS: Final = "gradients"
DOMINANCE: Final = "dominance"
DOMINANT_WEIGHTS: Final = "dominant weights"
DOMINANT_COUNTS: Final = "dominant counts"
ANTIALIASING: Final = "antialiased mode"
DOUBLE: Final = "double precision"
INSTRUMENTS: Final = "choices of what is asked for beside an image"
ROWWISE: Final = "rows computed one by one"
DETERMINISTIC: Final = "the same bits on every run"

# of a rasterizer with gsplat's signature; it is asked once for each (`views.ASKED`)
SIGNATURE: Final = "calls with gsplat's signature"
CAMERAS: Final = "several cameras in one call"
BATCHES: Final = "batch dimensions"
PACKED: Final = "packed rows"
DEPTH: Final = "depth modes"
COLORS: Final = "plain colours"
CHANNELS: Final = "colours of other numbers of channels than 3"
CAMERA_COLORS: Final = "colours of each camera"
COVARS: Final = "covariances in place of quaternions and scales"
RADIUS_CLIP: Final = "radius_clip"
PLANES: Final = "planes and low-pass other than its defaults"
NO_BACKGROUND: Final = "a call without backgrounds"
SPARSE_GRAD: Final = "sparse_grad"
SCALE: Final = "thousands of Gaussians in seconds"
# of one that has fewer bands, scenes are drawn without the others (`Adapter.sees`)
ALL_BANDS: Final = "harmonics of the third degree"

# what a scorecard lists of whole views
WHOLE: Final = (RENDER, GRADIENTS, DOMINANCE, DOMINANT_WEIGHTS, DOMINANT_COUNTS, ANTIALIASING, INSTRUMENTS,
                DETERMINISTIC, SCALE)  # fmt: skip

# these follow from the constants that are implemented
PROFILES: Final = "any profile"
LOWER_CEILING: Final = "profile gsplat_1_6"
INRIAS: Final = "profile inria"
EXTENTS: Final = "extents that hold all that is visible"
PRINCIPAL_POINT: Final = "principal point off the centre"
DERIVATIVES: Final = "gradients without exceptions"
HOMOGENEOUS: Final = "projection without a constant beside the depth"


def capabilities_of(profile: Profile | None) -> frozenset[str]:
    """Return the capabilities that follow from the one profile an implementation has, or from its taking any (None)."""
    if profile is None:
        return frozenset((PROFILES, LOWER_CEILING, INRIAS, EXTENTS, PRINCIPAL_POINT, DERIVATIVES, HOMOGENEOUS))
    found = {
        LOWER_CEILING: same_constants(profile, GSPLAT_1_6),
        INRIAS: same_constants(profile, INRIA),
        EXTENTS: profile.extent == "opacity_aware",
        PRINCIPAL_POINT: profile.principal_point == "used",
        # Inria's code divides by w + 1e-7, so a world of another size is drawn a little elsewhere
        HOMOGENEOUS: profile.principal_point == "used",
        DERIVATIVES: profile.clamp_gradient == "exact" and profile.ceiling_gradient == "zero",
    }
    return frozenset(need for need, offered in found.items() if offered)


def same_constants(one: Profile, other: Profile) -> bool:
    """Tell whether two profiles differ in their names at most."""
    return {**vars(one), "name": ""} == {**vars(other), "name": ""}
