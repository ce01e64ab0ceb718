"""What a run makes of its photographs: exposures, corrected cameras, random backgrounds, and fewer pixels at first."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import pop_ref.appearance
import pop_ref.refinement
from benchmarks.faults.runs import same
from pop_fast.api.backend import get_backend
from pop_fast.api.backends import CUDA
from pop_fast.data.capture import Capture
from pop_fast.data.gaussians import initialize_params
from pop_fast.errors import PopError
from pop_fast.stages import appearance as stages
from pop_fast.stages.losses import Loss, l1
from pop_fast.train import TrainingRun
from pop_fast.train import checkpoint as ckpt
from pop_fast.train import views as train_views
from pop_fast.train.appearance import Appearance
from pop_fast.train.choose import choose_backend
from pop_fast.train.config import TrainConfig
from pop_fast.train.engines import engine_of, torch_engine
from pop_fast.train.evaluate import psnr, psnr_after_correction
from pop_fast.train.presets import LOSSES
from pop_fast.train.schedule import phase_at
from pop_fast.train.steps import why_not_trained
from pop_fast.train.views import SMALLEST_SIDE, ViewTensors, render_view, shrunk, with_shrunk
from pop_ref.losses import photometric_pop, photometric_pop_vjp
from pop_ref.records import Camera
from pop_ref.render import render, render_vjp
from pop_ref.training import gaussians_from_params
from tests.app.tiny import last_checkpoint, run_until, skip_without, tiny_capture, tiny_config

pytestmark = pytest.mark.usefixtures("one_thread")

ALL = {"exposure": True, "random_background": True, "refine_cameras": True}
RNG = np.random.default_rng(21)
EXPOSURES = np.eye(3, 4) + RNG.normal(0.0, 0.2, (5, 3, 4))
CORRECTIONS = RNG.normal(0.0, 0.02, (5, 6))


def tensor(array: np.ndarray, requires_grad: bool = False) -> torch.Tensor:
    return torch.tensor(array, dtype=torch.float64, requires_grad=requires_grad)


def learned(run: TrainingRun) -> dict[str, torch.Tensor]:
    """Return the gradients that the next step leaves with what it learns of the photographs."""
    found: dict[str, torch.Tensor] = {}

    def keep(step: int) -> None:
        found.update({name: param.grad.clone() for name, param in run.appearance.params.items()})

    run.appearance.update = keep
    run.take_steps(run.step + 1)
    return found


@pytest.mark.parametrize("backend", ["fast", "compiled"])
@pytest.mark.parametrize("transparent", [False, True])
def test_the_gradients_of_a_step_are_the_oracles(tmp_path: Path, backend: str, transparent: bool) -> None:
    skip_without(backend)
    # l2 and half the light, with a hole in the scene: the background counts
    config = tiny_config(tmp_path / "run", l2_stop_iter=None, **ALL)
    capture = tiny_capture()
    if transparent:
        alpha = RNG.integers(0, 256, (24, 32), dtype=np.uint8)
        capture = replace(capture, views=tuple(replace(view, alpha=alpha) for view in capture.views))
    initial = initialize_params(capture, 7, 0.5, 0.5, torch.float64)
    start = {key: value.numpy().copy() for key, value in initial.items()}
    run = TrainingRun(config, capture, initial=initial, engine=torch_engine(backend))
    with torch.no_grad():
        run.appearance.params["exposures"].copy_(tensor(EXPOSURES[:4]))
        run.appearance.params["cameras"].copy_(tensor(CORRECTIONS[:4]))
    index = run.stepper._task.order[0]
    found = learned(run)

    view = capture.train_views(5)[index]
    gaussians = gaussians_from_params(start)
    exposure, correction = EXPOSURES[index], CORRECTIONS[index]
    viewmat = pop_ref.refinement.refined_viewmat(view.viewmat, correction)
    camera = Camera(viewmat, view.K, view.width, view.height)
    background = pop_ref.appearance.background_at(0, config.seed)
    image = render(gaussians, camera, background, sh_degree=0).image
    assert np.any(np.abs(image - render(gaussians, camera, sh_degree=0).image) > 0.05), "the background does not show"
    exposed = pop_ref.appearance.expose(image, exposure)
    target = view.image / 255.0
    if view.alpha is not None:
        behind = pop_ref.appearance.expose(background[None, None], exposure)[0, 0]
        target = pop_ref.appearance.over_background(target, view.alpha / 255.0, np.zeros(3), behind)
    given = (exposed, target)
    assert photometric_pop(*given) > 0.0
    v_exposed = photometric_pop_vjp(*given, 1.0)
    v_exposed = v_exposed[0] if isinstance(v_exposed, tuple) else v_exposed
    v_image, v_exposure = pop_ref.appearance.expose_vjp(image, exposure, v_exposed)
    gradients = render_vjp(gaussians, camera, v_image, background=background, sh_degree=0)
    _, v_correction = pop_ref.refinement.refined_viewmat_vjp(view.viewmat, correction, gradients.viewmat)

    for name, expected in (("exposures", v_exposure), ("cameras", v_correction)):
        scale = np.abs(expected).max()
        assert scale > 1e-6
        np.testing.assert_allclose(found[name][index], expected, rtol=0.0, atol=1e-9 * scale)
        others = [i for i in range(4) if i != index]
        assert torch.all(found[name][others] == 0.0)


COARSE = {"coarse_stop_iters": (9,)}
STOPPED = {
    "all": ALL,
    "coarse": COARSE,
    "coarse, exposures": {**COARSE, "exposure": True},
    "coarse, compiled": {**COARSE, "backend": "compiled"},
    "coarse, exposures, compiled": {**COARSE, "exposure": True, "backend": "compiled"},
}


@pytest.fixture
def tiny_may_shrink(monkeypatch: pytest.MonkeyPatch) -> None:
    """Views of 32 x 24 px may be halved."""
    monkeypatch.setattr(train_views, "SMALLEST_SIDE", 12)


@pytest.mark.usefixtures("tiny_may_shrink")
@pytest.mark.parametrize("what", STOPPED)
def test_a_run_that_was_stopped_goes_on_to_the_same_bits(what: str, tmp_path: Path) -> None:
    settings = STOPPED[what]
    skip_without(settings.get("backend", "fast"))
    # on either side of where photographs become whole
    for name, stops in (("whole", (None,)), ("parts", (7, 17 if what == "all" else 12, None))):
        for place, stop in enumerate(stops):
            run_until(TrainingRun(tiny_config(tmp_path / name, **settings), tiny_capture(), resume=place > 0), stop)
    ours, theirs = (last_checkpoint(tmp_path / name, "seconds", "metrics_bytes") for name in ("parts", "whole"))
    assert list(ours) == list(theirs)
    assert [name for name, value in ours.items() if not same(value, theirs[name])] == []
    if what == "all":
        assert ".appearance.cameras.exp_avg" in ours
        stats = (tmp_path / "parts" / "stats" / "appearance_step0029.json").read_text()
        assert stats == (tmp_path / "whole" / "stats" / "appearance_step0029.json").read_text()
        assert '"exposure"' in stats
        assert '"viewmat"' in stats


def test_settings_that_are_off_leave_views_and_images_as_they_are(tmp_path: Path) -> None:
    views = [ViewTensors.of(view) for view in tiny_capture().views]
    off = Appearance(tiny_config(tmp_path), views)
    image = torch.rand(4, 4, 3)
    assert off.params == {}
    assert off.seen_from(views[0], 0) is views[0]
    assert off.exposed(image, 0) is image
    assert off.background(3) is None
    assert off.seen(views) is views


def exposed_capture() -> Capture:
    """The tiny capture, each photograph with a gain of its own."""
    capture = tiny_capture()
    gains = np.linspace(0.6, 1.0, len(capture.views))
    views = [
        replace(view, image=np.rint(view.image * gain).astype(np.uint8))
        for view, gain in zip(capture.views, gains, strict=True)
    ]
    return replace(capture, views=tuple(views))


def test_exposures_take_up_the_gains_of_photographs_and_their_mean_stays(tmp_path: Path) -> None:
    config = tiny_config(tmp_path / "run", exposure=True, max_steps=30)
    run = TrainingRun(config, exposed_capture())
    stats = run.run()
    exposures = run.appearance.params["exposures"].detach()
    np.testing.assert_allclose(exposures.mean(0), np.eye(3, 4), atol=1e-6)
    # the first view is held out; the brighter a photograph, the larger the gain
    gains = exposures[:, range(3), range(3)].mean(1)
    assert gains[0] < gains[-1]
    assert stats["cc_psnr"] > stats["psnr"]
    assert set(stats["per_view"]["00.png"]) == {"psnr", "cc_psnr", "ssim"}


def test_psnr_after_correction_forgets_gain_and_offset_and_what_a_mask_hides() -> None:
    target = torch.rand(12, 12, 3, generator=torch.Generator().manual_seed(1))
    image, mask = 0.5 * target + 0.25, torch.ones(12, 12, dtype=torch.bool)
    assert psnr(image, target) < 20.0 < 90.0 < psnr_after_correction(image, target)
    mask[:, :4] = False
    image[:, :4] = 0.0
    assert psnr_after_correction(image, target) < 30.0 < 90.0 < psnr_after_correction(image, target, mask)


def test_cameras_that_are_a_little_off_are_found_again(tmp_path: Path) -> None:
    params = initialize_params(tiny_capture(), 7, 0.8, 1.0)
    rates = {"appearance_lr": replace(TrainConfig().appearance_lr, cameras=3e-3)}
    config, backend = tiny_config(tmp_path, refine_cameras=True, max_steps=150, **rates), get_backend("fast")
    true = [ViewTensors.of(view) for view in tiny_capture().views]
    viewmats = torch.cat([view.viewmat for view in true])
    # what moves all cameras alike cannot be found again
    errors = stages.without_common_motion(torch.tensor(CORRECTIONS).float(), viewmats)
    off = [
        replace(view, viewmat=stages.refined_viewmat(view.viewmat[0], error)[None])
        for view, error in zip(true, errors, strict=True)
    ]
    targets = [render_view(backend, params, view, config, 0).image for view in true]
    appearance = Appearance(config, off)
    losses: list[float] = []
    for step in range(150):
        index = step % len(off)
        image = render_view(backend, params, appearance.seen_from(off[index], index), config, 0).image
        loss = ((image - targets[index]) ** 2).mean()
        loss.backward()
        losses.append(loss.item())
        appearance.update(step)
    assert sum(losses[-5:]) < 0.1 * sum(losses[:5])
    after = torch.cat([view.viewmat for view in appearance.seen(off)])
    before = torch.cat([view.viewmat for view in off])
    assert (after - viewmats).square().mean() < 0.25 * (before - viewmats).square().mean()


def test_passes_see_the_cameras_as_they_are_corrected(tmp_path: Path) -> None:
    views = [ViewTensors.of(view) for view in tiny_capture().views]
    appearance = Appearance(tiny_config(tmp_path, refine_cameras=True), views)
    seen = appearance.seen(views)
    with torch.no_grad():
        appearance.params["cameras"][2] = torch.tensor(CORRECTIONS[2])
    assert len(seen) == len(views)
    assert torch.equal(seen[-3].viewmat, appearance.seen_from(views[2], 2).viewmat)
    assert not seen[2].viewmat.requires_grad
    assert not torch.equal(seen[2].viewmat, views[2].viewmat)


def test_transparency_matters_to_a_random_background_alone(tmp_path: Path) -> None:
    def losses(name: str, alpha: np.ndarray | None, **settings: Any) -> list[float]:
        capture = tiny_capture()
        capture = replace(capture, views=tuple(replace(view, alpha=alpha) for view in capture.views))
        config = tiny_config(tmp_path / name, **settings)
        steps = TrainingRun(config, capture).stepper.steps(0, 2, phase_at(config, config.strategy, 0))
        return [step.objective for step in steps]

    half = np.full((24, 32), 128, np.uint8)
    assert losses("a", half) == losses("b", None)
    assert losses("c", half, random_background=True) != losses("d", None, random_background=True)


@pytest.mark.parametrize("name", sorted(ALL))
def test_the_fused_step_refuses_each_setting_and_the_native_one_takes_exposures_alone(tmp_path, name):
    config = tiny_config(tmp_path, **{name: True})
    assert name in str(why_not_trained(CUDA, config))
    assert why_not_trained(CUDA, tiny_config(tmp_path)) is None
    skip_without("compiled")
    run = TrainingRun(replace(config, backend="compiled"), tiny_capture())
    assert run.stepper.name == ("native" if name == "exposure" else "torch")
    assert engine_of(replace(config, backend="compiled")).name == "compiled"


FORGED = {
    "value": (lambda a: a["exposures"].update(value=torch.ones(4, 3, 3)), "appearance.exposures.value"),
    "moment": (lambda a: a["cameras"].update(exp_avg=torch.ones(3, 6)), "appearance.cameras.exp_avg"),
    "negative": (lambda a: a["cameras"]["exp_avg_sq"].sub_(1.0), "appearance.cameras.exp_avg_sq"),
    "not finite": (lambda a: a["exposures"]["value"].fill_(float("nan")), "appearance.exposures.value"),
    "missing": (lambda a: a.pop("cameras"), "appearance has the rows"),
    "unknown": (lambda a: a.update(grids=a["cameras"]), "appearance.'grids'"),
    "fewer": (
        lambda a: a["cameras"].update(
            {key: a["cameras"][key][:2].clone() for key in ("value", "exp_avg", "exp_avg_sq")}
        ),
        "appearance has the rows",
    ),
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("appearance")
    TrainingRun(tiny_config(folder, max_steps=5, save_steps=(), **ALL), tiny_capture()).run()
    return folder


@pytest.mark.parametrize("case", FORGED)
def test_what_no_run_can_have_learned_is_refused_and_named(case: str, finished: Path, tmp_path: Path) -> None:
    damage, named = FORGED[case]
    path = ckpt.checkpoint_path(finished, 4)
    content = torch.load(path, weights_only=True)
    damage(content["appearance"])
    forged = ckpt.checkpoint_path(tmp_path, 4)
    forged.parent.mkdir()
    torch.save(content, forged)
    run = TrainingRun(tiny_config(tmp_path, max_steps=5, save_steps=(), **ALL), tiny_capture())
    with pytest.raises(PopError, match=named) as refused:
        run._restore(forged)
    assert str(forged) in str(refused.value)


def test_the_line_about_the_backend_says_that_autograd_takes_the_steps(tmp_path: Path, monkeypatch: Any) -> None:
    asked = replace(tiny_config(tmp_path), backend="compiled")
    assert choose_backend(asked)[1] == "backend compiled, as requested"
    # "has no photometric" told nobody that the fused step knows two losses, and not this one
    monkeypatch.setitem(LOSSES._given, "mine", Loss("mine", l1))
    for name, value in (("refine_cameras", True), ("photometric", "mine")):
        said = choose_backend(replace(asked, **{name: value}))[1]
        end = f"its fused step does not take {name} = {value}, so autograd is used"
        assert said == f"backend compiled, as requested; {end}"
    LOSSES.look_again()
    assert choose_backend(replace(asked, backend="fast", refine_cameras=True))[1] == "backend fast, as requested"
    assert choose_backend(replace(asked, exposure=True))[1] == "backend compiled, as requested"


# Coarse to fine: the laws judge what is seen at which step.


def made_view(height: int, width: int, **more: torch.Tensor) -> ViewTensors:
    K = torch.tensor([[[200.0, 0.0, 131.5], [0.0, 190.0, 77.25], [0.0, 0.0, 1.0]]])
    photo = torch.zeros(height, width, 3, dtype=torch.uint8)
    return ViewTensors("a.png", photo, more.pop("mask", None), torch.eye(4)[None], K, **more)


@pytest.mark.parametrize("factor", [2, 4])
def test_the_transparency_of_a_shrunk_view_is_the_mean_over_its_areas(factor: int) -> None:
    generator = torch.Generator().manual_seed(5)
    alpha = torch.randint(0, 256, (160, 256), generator=generator).to(torch.uint8)
    view = made_view(160, 256, alpha=alpha)
    small = shrunk(view, factor)
    opacity = alpha.numpy().reshape(160 // factor, factor, 256 // factor, factor).mean((1, 3))
    assert np.abs(small.alpha.numpy() - opacity).max() <= 0.5 + 1e-4
    assert (small.name, small.viewmat.tolist()) == (view.name, view.viewmat.tolist())
    assert with_shrunk([view], ()) == [view]


def test_a_view_is_not_shrunk_to_less_than_a_few_windows_nor_its_mask_to_nothing() -> None:
    assert shrunk(made_view(70, 300), 4).height == 35
    small = made_view(40, 300)
    assert shrunk(small, 4) is small
    assert min(shrunk(made_view(129, 300), 4).photo.shape[:2]) >= SMALLEST_SIDE
    keep = torch.zeros(160, 256, dtype=torch.bool)
    keep[3, 3] = True
    assert shrunk(made_view(160, 256, mask=keep), 4).kept_pixels == 1


@pytest.mark.parametrize("stops", [(5, 3), (-1,), (1, 2, 3, 4, 5)])
def test_stops_that_cannot_be_are_refused(stops: tuple[int, ...]) -> None:
    with pytest.raises(PopError, match="coarse_stop_iters"):
        TrainConfig(coarse_stop_iters=stops)
