"""The probe: it leaves the training alone, is taken up where a run is, and measures what it says."""

from __future__ import annotations

import json

import pytest
import torch

from paper_repro.collect import PROBE
from paper_repro.jobs import job_named
from paper_repro.probe import VIEWS, ProbedRun, gradient_sizes
from paper_repro.train_row import Options, capture_folder, load_capture_of
from pop_fast.stages import losses
from pop_fast.train import TrainingRun
from pop_fast.train.choose import choose_backend
from tests.app.interruptions import interrupt

STEPS = 24


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """A configuration of a few steps in some folder, and the demo capture."""
    folder = tmp_path_factory.mktemp("probe")
    job = job_named("pop", "demo", "toy")
    data = str(capture_folder(job.scene, Options(data=folder, work=folder)))

    def config(name: str):
        made = job.config(data=data, result_dir=str(folder / name), max_steps=STEPS, checkpoint_every=9, threads=1)
        return choose_backend(made)[0]

    return config, load_capture_of(job, config("none"))[0]


def probed(folder_of, name: str, capture, **more) -> ProbedRun:
    run = ProbedRun(folder_of(name), capture, every=5, **more)
    run.run()
    return run


def points(run: ProbedRun) -> dict:
    return json.loads((run._results.path / PROBE).read_text())


def test_a_probed_training_is_the_same_training(prepared):
    config, capture = prepared
    plain = TrainingRun(config("plain"), capture)
    plain.run()
    run = probed(config, "probed", capture)
    for key, value in plain.params.items():
        assert torch.equal(run.params[key], value), key
    assert list(points(run)) == ["0", "5", "10", "15", "20"]


def test_a_probe_is_the_mean_over_its_views(prepared):
    config, capture = prepared
    run = ProbedRun(config("alone"), capture, every=5)
    views = capture.train_views(run.config.test_every)
    assert [view.name for view in run._probed] == [views[i].name for i in (0, len(views) // 2, len(views) - 1)]
    together = run._probe()
    everything, singles = run._probed, []
    for view in everything:
        run._probed = [view]
        singles.append(run._probe())
    assert together["num_gaussians"] == len(run.params["means"])
    for name in ("grad_l1", "grad_l2", "grad_ssim", "probe_blended", "probe_traversed"):
        assert together[name] == pytest.approx(sum(one[name] for one in singles) / VIEWS, rel=1e-12)
        assert len({one[name] for one in singles}) == VIEWS or name == "grad_l1"
    assert together["probe_traversed"] >= together["probe_blended"] > 1.0


def test_what_was_probed_before_a_stop_is_taken_up(prepared, monkeypatch):
    config, capture = prepared
    whole = probed(config, "whole", capture)
    with monkeypatch.context() as patch:
        interrupt(patch, at=12)
        with pytest.raises(KeyboardInterrupt):
            probed(config, "stopped", capture)
    # the checkpoint is of step 9, and what was probed after it is not of this run any more
    stale = {**points(whole), "10": {"num_gaussians": 1}}
    (whole._results.path.parent / "stopped" / PROBE).write_text(json.dumps(stale))
    again = probed(config, "stopped", capture, resume=True)
    assert points(again) == points(whole)


def test_gradients_are_those_of_autograd_in_units_of_the_slope_of_l1():
    generator = torch.Generator().manual_seed(0)
    image = torch.rand((20, 24, 3), generator=generator, dtype=torch.float64).requires_grad_()
    photo = torch.rand((20, 24, 3), generator=generator, dtype=torch.float64)
    mask = torch.rand((20, 24), generator=generator) < 0.6
    for kept in (None, mask):
        n = image.numel() if kept is None else 3 * int(kept.sum())
        terms = {
            "grad_l1": losses.l1(image, photo, kept),
            "grad_l2": losses.l2(image, photo, kept),
            "grad_ssim": 0.01 * losses.d_ssim(image, photo, "valid", kept),
        }
        found = gradient_sizes(image.detach(), photo, kept)
        assert set(found) == set(terms)
        for name, term in terms.items():
            (gradient,) = torch.autograd.grad(term, image)
            # the mean over what counts, over 1 / (3HW) of what counts
            inside = gradient if kept is None else gradient[kept]
            assert found[name] == pytest.approx(float(inside.abs().mean()) * n, rel=1e-12), name
        assert found["grad_l1"] == pytest.approx(1.0, rel=1e-12)
