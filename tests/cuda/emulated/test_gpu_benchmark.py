"""The GPU's benchmark from end to end on a scene of a few splats: its numbers mean nothing here, but all are there."""

from __future__ import annotations

import json
import math
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch

import pop_fast.api.rasterize
from pop_fast.cli import main
from pop_fast.stages.splatting import ProjectionSettings, covariances, project
from tests.app.captures import HEIGHT, WIDTH, colmap_capture
from tests.cuda.emulated.rehearse import stand_in_card

BENCHMARKS = Path(__file__).resolve().parents[3] / "benchmarks"
STAND_IN = 'from pop_fast.api.rasterize import rasterization\n\n__version__ = "stand-in"\n'


@pytest.fixture
def bench(gpu, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    stand_in_card(monkeypatch)
    import gpu_gsplat
    import gpu_kernels

    for name, value in {"WARM_UP": 1, "REPEATS": 2, "STEPS": 4}.items():
        monkeypatch.setattr(gpu_kernels, name, value)
    monkeypatch.setattr(gpu_gsplat, "STEPS", 4)
    monkeypatch.delitem(sys.modules, "gsplat", raising=False)
    yield gpu_kernels
    # a stand-in is not left to other tests
    sys.modules.pop("gsplat", None)


def run(module, monkeypatch, out, *words):
    """Run a benchmark's command line; return its status and its file."""
    command = [module.__name__, str(out), "--device", "cpu", "--full-size", "3000", "--cases", "tiny", *words]
    monkeypatch.setattr(sys, "argv", command)
    status = module.main()
    return status, json.loads(out.read_text())


def numbers(tree):
    for value in tree.values():
        if isinstance(value, dict):
            yield from numbers(value)
        elif value is not None and not isinstance(value, str):
            yield value


@pytest.mark.rehearsal
def test_every_number_of_the_benchmark_is_measured(bench, gpu, monkeypatch, tmp_path):
    from gpu_kernels import KERNELS

    status, told = run(bench, monkeypatch, tmp_path / "bench.json")
    assert (status, list(told["cases"])) == (0, ["tiny"])
    assert told.keys() >= {"commit", "gpu", "torch", "card"}
    found = told["cases"]["tiny"]
    assert all(math.isfinite(number) for number in numbers(found))
    loads = found["pixel_parallel_by_kernel"]["loads"]
    assert 0 < loads["visible"] <= loads["gaussians"] == 40
    assert loads["pixels"] == 40 * 24
    assert 0 < loads["contributing"] <= loads["evaluated"] <= 128 * loads["instances"]
    assert found["gaussian_parallel_by_kernel"]["loads"] == loads
    timed = found["pixel_parallel_by_kernel"]["kernels"]
    assert set(timed) == set(KERNELS)
    assert {name for name, entry in timed.items() if "floor_ms" in entry} == {
        *("project", "count_tiles", "sort_by_depth", "number_instances", "make_tile_lists"),
        *("blend_forward", "photometric", "blend_backward", "update"),
    }
    for backward in ("pixel_parallel", "pixel_parallel_atomic", "gaussian_parallel", "gaussian_parallel_atomic"):
        assert found[backward]["step_with_pop_ms"] > 0.0
    assert found["pixel_parallel"]["step_kernels"].keys() == {"skipped"}


def test_gsplat_is_measured_beside_the_same_case(bench, monkeypatch, tmp_path):
    import gpu_gsplat

    # the CPU's rasterization has gsplat's signature
    (tmp_path / "gsplat.py").write_text(STAND_IN)
    monkeypatch.syspath_prepend(str(tmp_path))
    sums = iter(range(1, 100))
    for module in (bench, gpu_gsplat):
        monkeypatch.setattr(module, "kernel_sums", lambda run, calls=1: (run() and None) or {"kernels_ms": next(sums)})
    status, told = run(gpu_gsplat, monkeypatch, tmp_path / "beside.json")
    assert (status, told["gsplat"], told["gpu"]) == (0, "stand-in", "emulated")
    assert told["commit"]
    found = told["cases"]["tiny"]
    ours, theirs = found["ours"], found["gsplat"]
    assert found["ratios"]["forward"] == theirs["forward_ms"] / ours["forward_ms"]
    kernels = theirs["step_kernels"]["kernels_ms"] / ours["step_kernels"]["kernels_ms"]
    assert found["kernel_ratios"]["step"] == kernels


@pytest.mark.slow
def test_what_fails_is_told_and_takes_nothing_from_the_rest(bench, monkeypatch, tmp_path):
    """A part, a case and a scene that cannot be: each is told, and what comes after it is measured."""

    def raises(*arguments, **options):
        raise SystemExit("the families do not compile")

    monkeypatch.setattr(bench, "families_differ", raises)
    monkeypatch.setattr(bench, "photograph_of", raises)
    (tmp_path / "broken.npz").write_text("no zip")
    status, told = run(bench, monkeypatch, tmp_path / "bench.json", "--scenes", str(tmp_path / "broken.npz"))
    assert status == 1
    assert list(told["cases"]) == ["tiny", "broken", "broken_enlarged"]
    assert set(told["cases"]["tiny"]["failed"]) == {"families_differ", "photograph"}
    assert "the families do not compile" in told["cases"]["tiny"]["failed"]["photograph"]
    assert set(told["cases"]["broken"]["failed"]) == {"scene"}


def test_families_that_differ_are_told_beside_the_times(bench, monkeypatch):
    parts = bench.Record({}, lambda: None)
    monkeypatch.setattr(bench, "families_differ", lambda scene, case: {"means": 1e-6, "quats": float("nan")})
    monkeypatch.setattr(bench, "photograph_of", lambda scene, case: None)
    bench.measure(None, {}, None, parts)
    assert "differ by nan in quats" in parts.result["failed"]["families_differ"]


def test_kernel_times_are_added_up_by_name(bench):
    from gpu_kernels import summed

    def event(name, us, device=torch.autograd.DeviceType.CUDA, annotation=False):
        span = types.SimpleNamespace(elapsed_us=lambda: us)
        return types.SimpleNamespace(name=name, device_type=device, time_range=span, is_user_annotation=annotation)

    events = [event("blend", 500.0), event("blend", 300.0), event("Memset", 200.0), event("spin_kernel", 9e6)]
    events += [event("Optimizer.step", 800.0, annotation=True), event("aten::mul", 70.0, torch.autograd.DeviceType.CPU)]
    found = summed(events, 2)
    assert found == {"kernels_ms": pytest.approx(0.5), "launches": 1.5, "largest": {"blend": 0.4, "Memset": 0.1}}
    assert "saw no kernels" in summed([], 1)["skipped"]


def test_the_loss_that_gsplat_is_given_is_the_objective(bench, gpu):
    from gpu_gsplat import LAMBDA_SSIM, FusedLoss
    from gpu_scenes import TINY, activated_scene

    from pop_fast.stages.losses import photometric_pop

    g = torch.Generator().manual_seed(3)
    photograph = torch.randint(0, 256, (24, 40, 3), generator=g, dtype=torch.uint8)
    image = torch.rand((24, 40, 3), generator=g)
    found = FusedLoss(activated_scene(TINY, gpu), photograph).v_image(image)
    leaf = image.double().requires_grad_()
    photometric_pop(leaf, photograph.double() / 255.0, LAMBDA_SSIM).backward()
    torch.testing.assert_close(found.double(), leaf.grad, rtol=1e-3, atol=1e-3 * float(leaf.grad.abs().max()))


def test_a_packed_scene_is_what_the_run_left_behind(bench, gpu, tmp_path, capsys):
    from gpu_pack import pack_scene
    from gpu_scenes import packed_scene

    from pop_fast.train.load_result import load_splat

    capture, folder = colmap_capture(tmp_path / "scene"), tmp_path / "run"
    words = ["train", str(capture), "--out", str(folder), "--max-steps", "3", "--backend", "fast", "--quiet"]
    assert main(words) == 0, capsys.readouterr()
    path = pack_scene(folder, tmp_path)
    case, scene = packed_scene(path, gpu)
    params = load_splat(folder).params
    assert (case.name, case.n, case.width, case.height) == ("run", len(params["means"]), WIDTH, HEIGHT)
    torch.testing.assert_close(torch.logit(scene["opacities"]), params["opacities"], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(scene["sh"][:, :1], params["sh0"], rtol=1e-3, atol=1e-3)
    assert scene["sh"].shape == (case.n, 16, 3)
    assert scene["photograph"].shape == (HEIGHT, WIDTH, 3)
    image = bench.draw(pop_fast.api.rasterize.rasterization, scene, case)[0]
    assert image.std() > 0.01
    # the same picture, larger
    large_case, large = packed_scene(path, gpu, 4.0 * WIDTH * HEIGHT)
    assert (large_case.width / WIDTH, large_case.height / HEIGHT) == pytest.approx((2.0, 2.0), rel=0.4)
    drawn = bench.draw(pop_fast.api.rasterize.rasterization, large, large_case)[0][0]
    shrunk = torch.nn.functional.interpolate(drawn.permute(2, 0, 1)[None], (HEIGHT, WIDTH), mode="area")[0]
    assert float((shrunk.permute(1, 2, 0) - image[0]).abs().mean()) < 0.5 * float(image.std())
    assert packed_scene(path, gpu, 1.5 * WIDTH * HEIGHT) is None
    with np.load(path) as file:
        assert len(file["viewmats"]) == len(file["Ks"]) == len(file["sizes"])


def ncu_table(gpu_counters, kernels):
    """Return ncu's table of counters, one metric a line; every metric of a kernel has the same number."""
    stalls = [f"smsp__average_warps_issue_stalled_{name}_per_issue_active.ratio" for name in ("wait", "barrier")]
    metrics = [metric for metric, _ in gpu_counters.ASKED.values()] + stalls
    rows = [["ID", "Kernel Name", "Metric Name", "Metric Value"]]
    for k, (name, value) in enumerate(kernels.items()):
        rows += [[k, name, metric, value if "barrier" not in metric else "n/a"] for metric in metrics]
    return ["==PROF== Connected", *(",".join(f'"{cell}"' for cell in row) for row in rows)]


def test_counters_are_read_kernel_by_kernel(bench):
    import gpu_counters

    blend = "void pop::<unnamed>::blend_forward_kernel<(int)3, (pop::Collect)1, (bool)0>(pop::TileLists, int)"
    printed = ncu_table(gpu_counters, {blend: "1,000.26", "pop::begin_step_kernel(int)": "2"})
    first, second = gpu_counters.of_kernels(printed)
    assert (first["kernel"], second["kernel"]) == ("void pop::blend_forward_kernel<3, 1, 0>", "pop::begin_step_kernel")
    assert (first["us"], first["instructions"], first["issue_percent"]) == (1.0, 1000, 1000.3)
    assert first["warps_stalled_per_issue"] == {"wait": 1000.26, "barrier": 0.0}
    assert second["busy_percent"] == 100.0
    kept = json.loads(gpu_counters.as_json({"gpu": "a card"}, [first, second]))
    assert kept == {"gpu": "a card", "kernels": [first, second]}
    # what the table of NOTES.md is made of
    committed = json.loads((BENCHMARKS / "results" / "gpu" / "counters.json").read_text(encoding="utf-8"))
    assert all(set(kernel) == set(first) for kernel in committed["kernels"])


def test_counters_that_are_absent_are_told(bench, monkeypatch, tmp_path, capsys):
    import gpu_counters

    short = [line for line in ncu_table(gpu_counters, {"pop::a(int)": "1"}) if "smsp__inst_executed" not in line]
    with pytest.raises(ValueError, match=r"pop::a: ncu told nothing of smsp__inst_executed\.sum"):
        gpu_counters.of_kernels(short)
    with pytest.raises(ValueError, match="told of no kernel"):
        gpu_counters.of_kernels(["==ERROR== no permission"])
    monkeypatch.setattr(gpu_counters.shutil, "which", lambda name: None)
    monkeypatch.setattr(sys, "argv", ["gpu_counters", str(tmp_path / "counters.json")])
    assert gpu_counters.main() == 2
    assert "ncu was not found" in capsys.readouterr().err


# The benchmark's first case has the loads that times were predicted for, counted by the kernels themselves.

# what the predictions in benchmarks/NOTES.md are for, of the whole image, and of each of its pixels
VISIBLE, INSTANCES, EVALUATED, CONTRIBUTING, TRIED = 160_000, 2_000_000, 120.0, 35.0, 4_360_000
BY = 6


def _tried(case, device):
    """Count the tiles that are tried for a case, from its projection alone."""
    from gpu_scenes import activated_scene
    from gpu_visits import count_tried

    scene = activated_scene(case, device)
    view = ProjectionSettings(scene["Ks"][0], case.width, case.height)
    covars = covariances(scene["quats"], scene["scales"])
    splats = project(scene["means"], covars, scene["opacities"], scene["viewmats"][0], view)
    return count_tried(splats.means2d, splats.radii, case.width, case.height)


@pytest.mark.slow
def test_the_predicted_case_is_what_was_predicted(gpu, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from gpu_kernels import POP, make_trainer, step_loads
    from gpu_scenes import CASES, activated_scene

    whole, case = CASES[0], CASES[0].smaller(BY)
    assert (whole.n, whole.width * whole.height) == (270_000, pytest.approx(1.6e6, rel=0.01))
    photograph = torch.zeros((case.height, case.width, 3), dtype=torch.uint8)
    trainer = make_trainer(activated_scene(case, gpu), photograph, 2, replay=False, counts=True)
    trainer.run(1, POP)
    loads = step_loads(trainer)
    assert loads.visible * BY**2 == pytest.approx(VISIBLE, rel=0.05)
    # a small image cuts long splats off at its border: of the whole image the lists are a tenth longer
    assert loads.instances * BY**2 == pytest.approx(0.9 * INSTANCES, rel=0.1)
    assert loads.evaluated / loads.pixels == pytest.approx(EVALUATED, rel=0.1)
    assert loads.contributing / loads.pixels == pytest.approx(CONTRIBUTING, rel=0.1)
    # what the predictions take of the entries that are walked
    entries = loads.evaluated / 128
    assert loads.visits / entries == pytest.approx(0.774, rel=0.05)
    assert loads.eights / entries == pytest.approx(0.104, rel=0.05)
    assert loads.batches / entries == pytest.approx(0.0354, rel=0.05)
    # rectangles are longer than what they enclose, so that a small image cuts off more of them: of the whole one
    assert _tried(whole, gpu) == pytest.approx(TRIED, rel=0.05)
    # lists are as unequal as those of captures
    ((size, told),) = trainer.render_stats().items()
    assert size == (case.width, case.height)
    walked = told["n_traversed"].float()
    assert float(walked.quantile(0.99)) > 1.5 * float(walked.mean())
