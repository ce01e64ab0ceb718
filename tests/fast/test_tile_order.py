"""Tile lists are sorted stably, whatever the number of entries makes of the way they are sorted."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch

import cuda_ext
from pop_fast import compiled
from pop_fast.stages import tiles
from pop_fast.stages.tiles import tile_lists


@pytest.mark.parametrize("n", [0, 1, 4_096, 4_097, 30_000, 32_767, 32_768, 40_000])
def test_entries_are_front_to_back_and_ties_stay_in_order(n):
    rng = np.random.default_rng(n)
    # few depths, so that most are tied; the last is the largest that there is
    depths = torch.tensor(rng.choice([0.5, 1.0, 7.0, np.finfo(np.float32).max], n), dtype=torch.float32)
    tiles = rng.integers(0, 6, n)
    means2d = torch.tensor(np.stack((16 * (tiles % 3) + 8, 16 * (tiles // 3) + 8), 1), dtype=torch.float32)
    lists = tile_lists(means2d, torch.full((n, 2), 4, dtype=torch.int32), depths, 48, 32, 16)
    assert lists.offsets.tolist() == [0, *np.cumsum(np.bincount(tiles, minlength=6)).tolist()]
    assert lists.ids.tolist() == np.lexsort((np.arange(n), depths.numpy(), tiles)).tolist()


def test_the_test_of_a_tile_allows_as_much_on_every_backend():
    header = Path(cuda_ext.__file__).with_name("csrc") / "tiles.cuh"
    found = re.search(r"TILE_SLACK = (\S+), TILE_SLACK_SHARE = (\S+);", header.read_text())
    assert found is not None
    assert tuple(map(float, found.groups())) == (tiles.SLACK, tiles.SLACK_SHARE)
    # nowhere else is there another
    sources = [header, *Path(tiles.__file__).parent.rglob("*.py"), *Path(compiled.__file__).parent.glob("*.h")]
    slacks = [path.name for path in sources if re.search(r"\bslack\b.*=", path.read_text())]
    assert sorted(slacks) == ["lists.h", "tiles.cuh", "tiles.py"]
