"""Named profiles: every constant and every strictness that decides what a render is.

A render is defined by a `Profile`. Five names exist; `paper` is the default and equals `gsplat_1_5`, because POP was
built on gsplat 1.5 (clamp 0.999, before 1.6). The profile is a value that is passed, never a global.

Decisions, that is everything discontinuous, carry labels that can be searched for in code, docstrings, margins, CUDA
source and tests:

    D1 near plane            D2 extent and cull       D3 tile overlap        D4 depth order and ties
    D5 alpha floor           D6 alpha ceiling         D7 transmittance stop  D8 dominance tie

Gradient kinks: B1 frustum clamp in J, B2 colour clamp at 0, B3 alpha ceiling, B4 loss kinks.

The ceiling of 0.99 is the number that float32 kernels hold, 0.9900000095367432. Two splats at it would leave
9.99998e-5, under the stop, so the second ends the pixel. Under float64's own 0.99 they would leave the square of
0.010000000000000009, over the stop, and the second would be blended.

Sources: diff-gaussian-rasterization 59f5f77 (`inria`), gsplat v1.5.0-1.5.3 (`gsplat_1_5`), gsplat main from 2026-03
(`gsplat_1_6`: clamp 0.99), Hanson et al. 2025 (Speedy-Splat, `speedy_splat`), the POP paper section 3.1 (transmittance
stop `T <= 1e-4`).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Final, Literal

import numpy as np

from pop_ref.registry import Registry

DECISIONS: Final = {
    "D1": "near plane: is the centre in front of it",
    "D2": "extent and cull: how far a splat reaches, and whether it reaches the image",
    "D3": "tile overlap: which tile lists hold the splat",
    "D4": "depth order and ties: equal depths keep index order",
    "D5": "alpha floor: a splat under it is skipped at that pixel",
    "D6": "alpha ceiling: alpha is clamped to it",
    "D7": "transmittance stop: the splat that would pass it is not blended and ends the pixel",
    "D8": "dominance tie: equal weights go to the front splat",
}

KINKS: Final = {
    "B1": "frustum clamp in the projection's Jacobian",
    "B2": "colour clamp at 0",
    "B3": "alpha ceiling",
    "B4": "kinks of the losses (sign of zero in L1)",
}


@dataclass(frozen=True)
class Profile:
    """The table of constants that defines a render.

    Attributes:
        name: the profile's name.
        near_plane: camera z in world units at or under which a Gaussian is culled (D1); see `NEAR_IN_CAPTURE_UNITS`.
        near_inclusive: True culls `z <= near_plane`, False culls `z < near_plane` (D1).
        far_plane: camera z in world units beyond which a Gaussian is culled (D1).
        eps2d: low-pass, px^2 added to both diagonal entries of the screen covariance.
        frustum_margin: the Jacobian's x/z and y/z are clamped this many tan(fov/2) outside the image (B1).
        principal_point: "used" takes cx and cy from K, "centred" replaces them by W/2 and H/2 throughout.
        clamp_gradient: "exact" differentiates the clamped Jacobian, "inria" omits the clamp's z term (B1).
        extent: "opacity_aware" is the rectangle that holds every pixel with alpha >= alpha_floor,
            "square" is Inria's square of 3 standard deviations of the larger axis (D2).
        extent_sigmas: upper bound of the extent in standard deviations (D2).
        alpha_floor: alpha under it is skipped (D5); over 0, as extents end where alpha falls under it.
        alpha_ceiling: alpha is clamped to it (D6); 0.99 is float32's, see the module's text.
        ceiling_gradient: "zero" stops the gradient of a clamped alpha, "pass" lets it through (B3).
        transmittance_stop: the transmittance at which a pixel ends (D7).
        stop_inclusive: True stops at `T <= transmittance_stop`, False at `T <` (D7).
        tile_size: px; part of the meaning in `inria` only (D3).
    """

    name: str
    near_plane: float
    near_inclusive: bool
    far_plane: float
    eps2d: float
    frustum_margin: float
    principal_point: Literal["used", "centred"]
    clamp_gradient: Literal["exact", "inria"]
    extent: Literal["opacity_aware", "square"]
    extent_sigmas: float
    alpha_floor: float
    alpha_ceiling: float
    ceiling_gradient: Literal["zero", "pass"]
    transmittance_stop: float
    stop_inclusive: bool
    tile_size: int

    def as_numbers(self) -> dict[str, float]:
        """Return the constants as compiled code has them: numbers by name, and every choice of two as a flag.

        The flags are `centred` (the principal point), `inria_clamp` (B1), `square` (D2, D3) and `pass_ceiling` (B3).
        """
        words = {"name", "principal_point", "clamp_gradient", "extent", "ceiling_gradient"}
        return {
            **{field.name: getattr(self, field.name) for field in fields(self) if field.name not in words},
            "centred": self.principal_point == "centred",
            "inria_clamp": self.clamp_gradient == "inria",
            "square": self.extent == "square",
            "pass_ceiling": self.ceiling_gradient == "pass",
        }

    def require_floor(self) -> None:
        """Raise ValueError where no extent holds all that is seen: alpha falls under a floor of 0 or less nowhere."""
        if self.alpha_floor <= 0.0:
            raise ValueError(f"profile {self.name!r}: alpha_floor is {self.alpha_floor}; it must be in (0, 1)")


GSPLAT_1_5: Final = Profile(
    name="gsplat_1_5",
    near_plane=0.01,
    near_inclusive=False,
    far_plane=1e10,
    eps2d=0.3,
    frustum_margin=0.3,
    principal_point="used",
    clamp_gradient="exact",
    extent="opacity_aware",
    extent_sigmas=3.33,
    alpha_floor=1.0 / 255.0,
    alpha_ceiling=0.999,
    ceiling_gradient="zero",
    transmittance_stop=1e-4,
    stop_inclusive=True,
    tile_size=16,
)

# what two splats at it leave decides D7, so it has to be the 0.99 that the kernels hold
_CEILING_99: Final = float(np.float32(0.99))

GSPLAT_1_6: Final = replace(GSPLAT_1_5, name="gsplat_1_6", alpha_ceiling=_CEILING_99)

PAPER: Final = replace(GSPLAT_1_5, name="paper")

INRIA: Final = Profile(
    name="inria",
    near_plane=0.2,
    near_inclusive=True,
    far_plane=1e10,
    eps2d=0.3,
    frustum_margin=0.3,
    principal_point="centred",
    clamp_gradient="inria",
    extent="square",
    extent_sigmas=3.0,
    alpha_floor=1.0 / 255.0,
    alpha_ceiling=_CEILING_99,
    ceiling_gradient="pass",
    transmittance_stop=1e-4,
    stop_inclusive=False,
    tile_size=16,
)

# Speedy-Splat draws with Inria's constants and lists whatever is bright enough to be seen (SnugBox)
SPEEDY_SPLAT: Final = replace(INRIA, name="speedy_splat", extent="opacity_aware", extent_sigmas=3.33)

# other packages add theirs under the entry point group, or with `PROFILES.register`
PROFILES: Final[Registry[Profile]] = Registry(
    "profile",
    "pop_splatting.profiles",
    {p.name: p for p in (PAPER, GSPLAT_1_5, GSPLAT_1_6, INRIA, SPEEDY_SPLAT)},
    needs=tuple(field.name for field in fields(Profile)),
)

# profiles whose near plane is a length of the capture's own world: Inria's family trains in COLMAP's units. In a world
# that was scaled it lies as many times farther (`TrainConfig.in_world`)
NEAR_IN_CAPTURE_UNITS: Final = frozenset({INRIA.name, SPEEDY_SPLAT.name})


def profile_named(name: str) -> Profile:
    """Return the profile of that name.

    Source: the rasterizers named in this module's docstring.
    Departs: nothing.

    Args:
        name: one of "paper", "gsplat_1_5", "gsplat_1_6", "inria", "speedy_splat", or of another package's.

    Returns:
        The profile.

    Raises:
        ValueError: the name is not a profile's.

    Example:
        >>> profile_named("gsplat_1_6").alpha_ceiling
        0.9900000095367432
    """
    return PROFILES.named(name)
