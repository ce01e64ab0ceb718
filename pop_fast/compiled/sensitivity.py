"""How much a view's pixels react to every Gaussian, by the compiled library. Meaning: `pop_ref.sensitivity`."""

from __future__ import annotations

from torch import Tensor

from pop_fast.compiled.library import SensitivityScores
from pop_fast.compiled.scores import totals
from pop_fast.stages.blend.pairs import background_or_black, check_grid
from pop_fast.stages.splatting import Splats, colors_of
from pop_fast.stages.tiles import TileLists
from pop_ref.constants import PAPER, Profile


def sensitivities(
    splats: Splats,
    lists: TileLists,
    width: int,
    height: int,
    tile_size: int,
    background: Tensor | None = None,
    profile: Profile = PAPER,
) -> Tensor:
    """See `pop_ref.sensitivity.sensitivities`. [N] float64

    Optimizations: the sum of the channels is blended as one, in C++, there and back (`scores.h`).
    """
    check_grid(lists, width, height, tile_size)
    colors = colors_of(splats)
    behind = background_or_black(background, colors).sum(0, keepdim=True)
    grey = colors.sum(1, keepdim=True)
    found = totals(SensitivityScores, 1, splats, grey, lists, (width, height), profile, background=behind)
    return found[:, 0] * splats.opacities.double().square()
