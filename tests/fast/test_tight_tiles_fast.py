"""Exact tile lists of many splats at once: the oracle's, and no shorter than what can be blended."""

from __future__ import annotations

import itertools

import pytest
import torch

from pop_fast.stages.tight_tiles import tight_tile_lists
from pop_fast.stages.tiles import TileLists, tile_lists
from pop_ref.constants import INRIA, PAPER, SPEEDY_SPLAT, Profile
from pop_ref.tight_tiles import tight_tile_lists as oracle_lists
from tests.fast.test_compiled import HEIGHT, WIDTH
from tests.fast.test_compiled import splats as draw

PROFILES = [PAPER, INRIA, SPEEDY_SPLAT]


def by_tile(lists: TileLists) -> list[list[int]]:
    return [lists.ids[a:b].tolist() for a, b in itertools.pairwise(lists.offsets.tolist())]


def arguments(tile_size: int):
    drawn = draw(tile_size, n=300)
    generator = torch.Generator().manual_seed(4)
    radii = torch.randint(0, 24, (300, 2), generator=generator, dtype=torch.int32)
    depths = 1.0 + torch.rand(300, generator=generator, dtype=torch.float64)
    return drawn.means2d, drawn.conics, drawn.opacities, radii, depths, WIDTH, HEIGHT, tile_size


@pytest.mark.parametrize("tile_size", [4, 16])
@pytest.mark.parametrize("profile", PROFILES, ids=lambda profile: profile.name)
def test_tight_lists_are_the_oracles(profile: Profile, tile_size: int) -> None:
    given = arguments(tile_size)
    arrays = [t.numpy() for t in given[:5]]
    arrays[3] = arrays[3].astype("int64")
    expected = oracle_lists(*arrays, *given[5:], profile)
    assert sum(map(len, expected)) > 400
    assert by_tile(tight_tile_lists(*given, profile)) == expected


@pytest.mark.parametrize("profile", PROFILES, ids=lambda profile: profile.name)
def test_a_tile_whose_pixel_centres_are_met_is_met(profile: Profile) -> None:
    means2d, conics, opacities, radii, depths, *grid = arguments(4)
    tight = by_tile(tight_tile_lists(means2d, conics, opacities, radii, depths, *grid, profile))
    exact = by_tile(tile_lists(means2d, radii, depths, *grid, profile, conics=conics, opacities=opacities))
    whole = by_tile(tile_lists(means2d, radii, depths, *grid, profile))
    for few, some, many in zip(exact, tight, whole, strict=True):
        # at the rim of a tile a pixel centre is half a pixel inside, which is more than the slack of `tile_lists`
        assert [i for i in some if i in few] == few
        assert [i for i in many if i in some] == some
    assert sum(map(len, exact)) < sum(map(len, tight)) < sum(map(len, whole))
