"""The GPU's benchmark from end to end on a scene of a few splats: its numbers mean nothing here, but all are there."""

from __future__ import annotations

import json
import math
import sys
import time
import types
from pathlib import Path

import pytest
import torch

import pop_fast.rasterization
from pop_fast.cli import main
from pop_fast.cli.splat import load_splat
from tests.app.captures import HEIGHT, WIDTH, colmap_capture

BENCHMARKS = Path(__file__).resolve().parents[3] / "benchmarks"


class StandInEvent:
    """A CUDA event where everything is done at once."""

    def __init__(self, enable_timing=False):
        self.at = None

    def record(self):
        self.at = time.perf_counter()

    def synchronize(self):
        assert self.at is not None

    def elapsed_time(self, end):
        return 1e3 * (end.at - self.at)


@pytest.fixture
def bench(gpu, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setattr(torch.cuda, "Event", StandInEvent)
    monkeypatch.setattr(torch.cuda, "_sleep", lambda cycles: None)
    properties = types.SimpleNamespace(multi_processor_count=2)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: properties)
    import gpu_kernels

    for name, value in {"WARM_UP": 1, "REPEATS": 2, "STEPS": 4}.items():
        monkeypatch.setattr(gpu_kernels, name, value)
    monkeypatch.delitem(sys.modules, "gsplat", raising=False)
    yield gpu_kernels
    # a stand-in is not left to other tests
    sys.modules.pop("gsplat", None)


def numbers(tree):
    for value in tree.values():
        if isinstance(value, dict):
            yield from numbers(value)
        elif not isinstance(value, str):
            yield value


def test_every_number_of_the_benchmark_is_measured(bench, gpu, monkeypatch, tmp_path):
    from gpu_floors import measured_card
    from gpu_scenes import GpuCase, activated_scene
    from gpu_steps import KERNELS

    # the CPU's rasterization has gsplat's signature
    words = 'from pop_fast.rasterization import rasterization\n\n__version__ = "stand-in"\n'
    (tmp_path / "gsplat.py").write_text(words)
    monkeypatch.syspath_prepend(str(tmp_path))
    case = GpuCase("tiny", 40, 40, 24, 4.0)
    scene = activated_scene(case, gpu)
    found = bench.measure(case, scene, measured_card(gpu, copied=1 << 16))
    json.dumps(found)
    assert all(math.isfinite(number) for number in numbers(found))
    loads = found["columns_by_kernel"]["loads"]
    assert 0 < loads["visible"] <= loads["gaussians"] == 40
    assert loads["pixels"] == 40 * 24
    assert 0 < loads["contributing"] <= loads["evaluated"] <= 128 * loads["instances"]
    assert found["splats_by_kernel"]["loads"] == loads
    timed = found["columns_by_kernel"]["kernels"]
    assert set(timed) == set(KERNELS)
    assert {name for name, entry in timed.items() if "floor_ms" in entry} == {
        *("project", "count_instances", "make_tile_lists", "blend_forward", "photometric"),
        *("blend_backward", "update"),
    }
    assert set(found["ratios"]) == {"forward", "backward", "forward_backward", "step"}
    for family in ("columns", "columns_atomic", "splats", "splats_atomic"):
        assert found[family]["step_with_pop_ms"] > 0.0


def test_the_loss_that_gsplat_is_given_is_the_objective(bench, gpu):
    from gpu_gsplat import LAMBDA_SSIM, FusedLoss
    from gpu_scenes import GpuCase, activated_scene

    from pop_fast.losses import photometric_pop

    case = GpuCase("tiny", 5, 40, 24, 4.0)
    g = torch.Generator().manual_seed(3)
    photograph = torch.randint(0, 256, (24, 40, 3), generator=g, dtype=torch.uint8)
    image = torch.rand((24, 40, 3), generator=g)
    found = FusedLoss(activated_scene(case, gpu), photograph).v_image(image)
    leaf = image.double().requires_grad_()
    photometric_pop(leaf, photograph.double() / 255.0, LAMBDA_SSIM).backward()
    torch.testing.assert_close(found.double(), leaf.grad, rtol=1e-3, atol=1e-3 * float(leaf.grad.abs().max()))


def test_a_trained_scene_is_what_the_run_left_behind(bench, gpu, tmp_path, capsys):
    from gpu_scenes import trained_scene

    capture, run = colmap_capture(tmp_path / "scene"), tmp_path / "run"
    words = ["train", str(capture), "--out", str(run), "--max-steps", "3", "--backend", "fast", "--quiet"]
    assert main(words) == 0, capsys.readouterr()
    case, scene = trained_scene(run, gpu)
    params = load_splat(run).params
    assert (case.name, case.n, case.width, case.height) == ("run", len(params["means"]), WIDTH, HEIGHT)
    torch.testing.assert_close(torch.logit(scene["opacities"]), params["opacities"], rtol=1e-4, atol=1e-4)
    assert scene["sh"].shape == (case.n, 16, 3)
    image = bench.draw(pop_fast.rasterization.rasterization, scene, case)[0]
    assert image.std() > 0.01
