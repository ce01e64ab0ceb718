"""What the blend does beside blending: tiles ordered by their lists' lengths, maps that are told when asked."""

import pytest
import torch

from cuda_ext.arrays import Settings
from cuda_ext.render.lists import WARP_TILE, make_lists, splat_struct
from cuda_ext.training.resident import ResidentViews
from cuda_ext.training.train_step import FusedTrainer
from pop_fast.train.schedule import steady_updates
from pop_fast.train.steps import Phase, StepSettings
from pop_ref.constants import PAPER

WIDTH, HEIGHT = 90, 50
BIN_WIDTH = 8  # lists whose lengths differ by less may stand in any order


def corner_lists(n: int):
    # all in one corner, so that lists there are long and most others empty
    g = torch.Generator().manual_seed(n)
    rows = {
        "means2d": 30.0 * torch.rand((n, 2), generator=g) ** 2,
        "depths": 1.0 + torch.rand((n,), generator=g),
        "conics": torch.tensor([[0.02, 0.0, 0.02]]).repeat(n, 1),
        "opacities": torch.full((n,), 0.5),
        "radii": torch.full((n, 2), 22, dtype=torch.int32),
    }
    settings = Settings(WIDTH, HEIGHT, PAPER, PAPER.tile_size)
    return make_lists(settings, splat_struct(**rows, colors=None), n, torch.device("cpu"), WARP_TILE, True)


@pytest.mark.parametrize("n", [1, 60, 300])
def test_tiles_are_taken_longest_list_first_and_each_once(gpu, n):
    lists = corner_lists(n)
    order, begin, end = (lists.tensor(name).long() for name in ("tile_order", "tile_begin", "tile_end"))
    assert sorted(order.tolist()) == list(range(lists.n_tiles))
    lengths = (end - begin)[order] // BIN_WIDTH
    assert lengths.tolist() == sorted(lengths.tolist(), reverse=True)
    assert n == 1 or lengths[0] > lengths[-1]


def told(gpu, counts: bool):
    g = torch.Generator().manual_seed(5)
    n = 40
    params = {
        "means": torch.rand((n, 3), generator=g) - 0.5 + torch.tensor([0.0, 0.0, 2.0]),
        "scales": torch.full((n, 3), -2.0),
        "quats": torch.randn((n, 4), generator=g),
        "opacities": torch.randn((n,), generator=g),
        "sh0": torch.randn((n, 1, 3), generator=g),
        "shN": torch.zeros((n, 15, 3)),
    }
    m, v = ({name: torch.zeros_like(value) for name, value in params.items()} for _ in range(2))
    K = torch.tensor([[[60.0, 0.0, 20.0], [0.0, 60.0, 12.0], [0.0, 0.0, 1.0]]])
    photograph = torch.zeros((24, 40, 3), dtype=torch.uint8)
    views = ResidentViews([photograph], torch.eye(4)[None], K, None, "valid", gpu)
    settings = StepSettings(steady_updates(dict.fromkeys(params, 1e-3), 2), replay=False, counts=counts)
    trainer = FusedTrainer(params, m, v, views, [0, 0], settings)
    trainer.run(2, Phase(0, True, True, True))
    ((_, maps),) = trainer.render_stats().items()
    return maps, params


def test_training_tells_the_same_winners_without_the_counts(gpu):
    (lean, after), (full, after_full) = told(gpu, counts=False), told(gpu, counts=True)
    assert set(full) - set(lean) == {"n_blended", "n_traversed"}
    for name, found in lean.items():
        assert torch.equal(found, full[name]), name
    assert (lean["dominant_ids"] >= 0).any()
    assert int(lean["dominant_counts"].sum()) == int((lean["dominant_ids"] >= 0).sum())
    assert all(torch.equal(after[name], after_full[name]) for name in after)
