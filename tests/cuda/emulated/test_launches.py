"""What a step asks of a GPU: how many nodes its graph has, when one is captured, and on which device it all is."""

from __future__ import annotations

import sys
from collections import Counter
from contextlib import contextmanager

import pytest
import torch

from cuda_ext.arrays import Settings
from cuda_ext.host import emulate
from cuda_ext.render.lists import WARP_TILE, make_lists, splat_struct
from cuda_ext.training.step_buffers import ResidentViews
from cuda_ext.training.train_step import FusedTrainer
from pop_fast.density.passes import Passes
from pop_fast.train.schedule import steady_updates
from pop_fast.train.steps import Phase, StepSettings
from pop_ref.constants import PAPER
from tests.cuda.conftest import FOLDER
from tests.cuda.gpu.scene import HEIGHT, STEPS, WIDTH, fused_trainer, training_scene
from tests.fast.pass_scenes import raw_params, views

POP = Phase(3, True, True, True)
SORTS_AND_SCANS = {"DeviceRadixSort", "DeviceScan", "memset"}


def nodes_of_a_step(gpu, phase, **settings):
    _, trainer = fused_trainer(training_scene(), gpu, **settings)
    trainer.run(1, phase)
    emulate.nodes(emulate.build(FOLDER))
    trainer.run(2, phase)
    return emulate.nodes(emulate.build(FOLDER))


def test_a_step_is_few_kernels_each_launched_once(gpu):
    found = nodes_of_a_step(gpu, POP)
    own = {name: times for name, times in found.items() if name not in SORTS_AND_SCANS}
    assert set(own.values()) == {1}
    # with 22 of sorts and scan, whatever a photograph's size: it was 44 with clears, a total and a packing of their own
    assert len(own) <= 15, sorted(own)


def test_nothing_is_cleared_by_a_launch_of_its_own(gpu):
    found = nodes_of_a_step(gpu, POP)
    # depths are sorted by 32 bits, the scene's 15 tiles by 4; all memsets are the sorts' own
    assert found["memset"] == (2 + 4) + (2 + 1)
    assert found["DeviceRadixSort"] == (2 + 4) + (2 + 1)
    assert found["DeviceScan"] == 2


def test_a_step_without_dominance_does_not_count_importance(gpu):
    assert "count_important_kernel" not in nodes_of_a_step(gpu, Phase(3, False, False, False))


def test_a_step_is_captured_when_its_kind_comes_again_and_once(gpu, monkeypatch):
    from cuda_ext.training import train_step

    captured, captures = train_step.captured, []

    def counting(launch, device):
        captures.append(launch)
        return captured(launch, device)

    monkeypatch.setattr(train_step, "captured", counting)
    scene = training_scene()
    # three views of three sizes: a kind is a size and a phase
    scene.photographs = [image[: HEIGHT - k, : WIDTH - k].contiguous() for k, image in enumerate(scene.photographs)]
    (params, m, v), trainer = fused_trainer(scene, gpu)
    trainer.run(3, POP)
    assert len(captures) == 0
    trainer.run(4, POP)
    assert len(captures) == 1
    trainer.run(7, POP)
    assert len(captures) == 3
    trainer.rebind(params, m, v)
    trainer.run(STEPS, POP)
    assert len(captures) == 3
    assert Counter(map(scene.order[7:].count, range(3))) == {1: 3}


@pytest.fixture
def guarded(gpu, monkeypatch):
    """Fail on a launch outside of `torch.cuda.device_of(a tensor)`, as a launch on another GPU would."""
    kernels, depth = sys.modules["cuda_ext._kernels"], []

    @contextmanager
    def device_of(tensor):
        assert isinstance(tensor, torch.Tensor)
        depth.append(tensor)
        yield
        depth.pop()

    class Guarded:
        def __getattr__(self, name):
            found = getattr(kernels, name)
            if not callable(found) or isinstance(found, type) or name in emulate.QUERIES:
                return found

            def launch(*arguments):
                assert depth, f"{name} is launched on whatever device is current"
                return found(*arguments)

            return launch

    monkeypatch.setitem(sys.modules, "cuda_ext._kernels", Guarded())
    monkeypatch.setattr(torch.cuda, "device_of", device_of)
    return gpu


def test_fused_steps_are_launched_on_the_tensors_device(guarded):
    for replay in (True, False):
        _, trainer = fused_trainer(training_scene(), guarded, replay=replay)
        trainer.run(STEPS, POP)


def test_a_render_and_its_gradients_are_launched_on_the_tensors_device(guarded):
    from pop_fast.cuda import rasterization

    scene = training_scene()
    p = {name: value.requires_grad_() for name, value in scene.params.items()}
    image, _, meta = rasterization(
        p["means"], p["quats"], p["scales"].exp(), torch.sigmoid(p["opacities"]), p["sh0"], scene.viewmats[:1],
        scene.Ks[:1], WIDTH, HEIGHT, sh_degree=0,
    )  # fmt: skip
    image.sum().backward()
    assert bool(p["means"].grad.any())
    for key in ("isect_offsets", "n_traversed", "dominant_counts"):
        assert meta[key] is not None


def test_passes_are_launched_on_the_tensors_device(guarded):
    made = Passes("cuda", views(torch.float32), device=guarded)
    params = raw_params(dtype=torch.float32)
    assert bool(made.contributions(params, 0, 3, torch.ones(made.photo(0).shape[:2])).map_sum.any())
    assert bool(made.sensitivities(params, 0, 3).any())
    assert bool(made.fisher(params, 0, 3).any())
    assert bool((made.dominant_points(params, 0, 3)[1] >= 0).any())


# What the blend does besides blending: tiles ordered by their lists' lengths, maps that are told when asked.

BLEND_EXTRAS_WIDTH, BLEND_EXTRAS_HEIGHT = 90, 50
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
    settings = Settings(BLEND_EXTRAS_WIDTH, BLEND_EXTRAS_HEIGHT, PAPER, PAPER.tile_size)
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
