"""The adapters that come with the kit: what is not here is skipped with the reason, what is stands up to the laws."""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pop_ref.compositing import composite, composite_vjp
from pop_ref.conformance import Adapter, Scene
from pop_ref.conformance.adapter import under
from pop_ref.conformance.backends import ELSEWHERE, Absent, Unavailable, made_by, shipped, shipped_or_absent
from pop_ref.conformance.capabilities import DERIVATIVES, EXTENTS, GRADIENTS, INRIAS, LOWER_CEILING, PROFILES, RENDER
from pop_ref.conformance.failure_report import failure_report
from pop_ref.conformance.foreign_adapters import inria
from pop_ref.conformance.law import missing
from pop_ref.conformance.mutants import MUTANTS, living
from pop_ref.conformance.mutants.trial import every_law, law_named, obeys
from pop_ref.conformance.scenes import golden_scene, scene_as_code
from pop_ref.conformance.torch_adapter import TorchAdapter
from pop_ref.constants import GSPLAT_1_6, INRIA, PAPER
from pop_ref.constants import PROFILES as ALL_PROFILES
from pop_ref.projection import project_means
from tests.meta import inria_stub

LAWS = every_law()
FEW = 4
# one law for each thing that a conversion or a profile may get wrong
IMAGE = "test_agreement:the_image_is_one_of_the_oracles_outcomes"
GRADIENT = "test_agreement:gradients_are_the_oracles"
CEILING = "test_thresholds:at_the_alpha_ceiling_nothing_jumps"
SQUARE = "test_thresholds:the_square_extent_cuts_where_inrias_does"
BACKGROUND = "test_compositing:the_background_enters_with_the_remaining_light"
SHOWING = (
    *(IMAGE, GRADIENT, CEILING, SQUARE, BACKGROUND),
    "test_agreement:the_image_of_inrias_profile_is_the_oracles",
    "test_agreement:the_antialiased_image_is_one_of_the_oracles_outcomes",
    "test_thresholds:at_the_near_plane_a_splat_is_wholly_there_or_wholly_gone",
    "test_gradients:culled_gaussians_get_exactly_zero",
    "test_gradients:the_background_gradient_is_the_cotangent_seen_through_the_remaining_light",
    "test_whole:cropping_commutes_with_rendering",
)


def broken(backend: Any, *paths: str) -> list[str]:
    """Try laws that a backend has what they need for, and return those that break."""
    found = []
    for path in paths or SHOWING:
        if not missing(backend, LAWS[path].needs):
            try:
                breaks = obeys(LAWS[path], backend, FEW)
            except pytest.skip.Exception:
                continue
            found += [] if breaks is None else [path]
    return found


def test_an_unknown_name_is_answered_with_those_that_are_known() -> None:
    with pytest.raises(ValueError, match="backend 'gsplt' is unknown; use one of oracle, fast64, fast32, compiled64"):
        shipped("gsplt")


@pytest.mark.parametrize("name", ELSEWHERE)
def test_what_is_not_here_says_why(name: str) -> None:
    backend = shipped_or_absent(name)
    if isinstance(backend, Absent):
        assert not backend.has("render")
        assert len(backend.reason) > 20
        with pytest.raises(Unavailable):
            shipped(name)
    else:
        assert backend.name == name


@pytest.mark.skipif(importlib.util.find_spec("gsplat") is not None, reason="gsplat is installed here")
def test_a_package_that_is_not_installed_is_named() -> None:
    assert shipped_or_absent("gsplat").reason == "gsplat needs gsplat, which is not installed"


def test_a_rasterizer_that_needs_a_gpu_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.setitem(sys.modules, "diff_gaussian_rasterization", inria_stub)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    reason = shipped_or_absent("diff-gaussian-rasterization").reason
    assert reason == "diff-gaussian-rasterization needs a CUDA device, and torch finds none"


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_inrias_interface_is_judged_through_its_adapter(dtype: str) -> None:
    adapter = inria("stub", inria_stub, dtype, "cpu")
    assert not broken(adapter)
    assert not missing(adapter, (RENDER, GRADIENTS, INRIAS))
    assert missing(adapter, (PROFILES, EXTENTS, DERIVATIVES, LOWER_CEILING))
    g = adapter.gradients(adapter.sees(golden_scene()), np.ones((16, 16, 3)), np.zeros((16, 16)))
    assert set(g) == {"means", "quats", "scales", "opacities", "sh", "means2d"}


def _changed(change: Callable[[Any], dict[str, Any]]) -> SimpleNamespace:
    """Return the stub with other settings than the adapter gave it."""

    def settings(**given: Any) -> Any:
        made = inria_stub.GaussianRasterizationSettings(**given)
        return made._replace(**change(made))

    settings._fields = inria_stub.GaussianRasterizationSettings._fields  # type: ignore[attr-defined]
    return SimpleNamespace(GaussianRasterizationSettings=settings, GaussianRasterizer=inria_stub.GaussianRasterizer)


@pytest.mark.parametrize(
    "change",
    [
        lambda s: {"viewmatrix": s.viewmatrix.T},
        lambda s: {"projmatrix": s.projmatrix.T},
        lambda s: {"campos": s.campos + 1.0},
        lambda s: {"tanfovx": s.tanfovy, "tanfovy": s.tanfovx},
        lambda s: {"bg": s.bg * 0.5},
        lambda s: {"sh_degree": 0},
    ],
    ids=["view", "projection", "place", "field of view", "background", "degree"],
)
def test_a_slip_in_the_conversion_would_be_noticed(change: Callable[[Any], dict[str, Any]]) -> None:
    adapter = inria("slip", _changed(change), "float64", "cpu")
    assert obeys(LAWS[IMAGE], adapter) is not None


def fixed(profile: str) -> TorchAdapter:
    """Judge pop_fast as a stranger who has one profile and gsplat's arguments."""
    from pop_fast.api.rasterize import rasterization as sound

    def rasterization(*args: Any, rasterize_mode: str = "classic", **options: Any) -> Any:
        options["near_plane"] = ALL_PROFILES[profile].near_plane
        options["rasterize_mode"] = rasterize_mode
        image, alphas, meta = sound(*args, profile=profile, **options)
        return image, alphas, {"means2d": meta["means2d"], "radii": meta["radii"]}

    return TorchAdapter(f"fixed {profile}", rasterization, profile=ALL_PROFILES[profile])


@pytest.mark.parametrize("profile", ["gsplat_1_6", "inria"])
def test_a_rasterizer_with_one_profile_is_judged_under_it(profile: str) -> None:
    adapter = fixed(profile)
    assert not broken(adapter)
    assert adapter.sees(golden_scene()).profile == ALL_PROFILES[profile]


def test_a_rasterizer_of_another_profile_than_it_claims_is_noticed() -> None:
    adapter = fixed("paper")
    adapter.profile = GSPLAT_1_6
    assert broken(adapter, CEILING) == [CEILING]
    adapter.profile = INRIA
    assert broken(adapter, SQUARE) == [SQUARE]


def test_a_centred_camera_shows_gaussians_where_they_were() -> None:
    scene = golden_scene()
    moved = under(scene, INRIA)
    p, q = (s.gaussians.means @ s.camera.viewmat[:3, :3].T + s.camera.viewmat[:3, 3] for s in (scene, moved))
    np.testing.assert_allclose(q[:, 2], p[:, 2], rtol=1e-12)
    there, here = (project_means(x, s.camera.K, 16, 16, PAPER) for x, s in ((p, scene), (q, moved)))
    np.testing.assert_allclose(here, there, rtol=1e-12)
    assert moved.camera.K[:2, 2].tolist() == [8.0, 8.0]
    assert repr(under(moved, INRIA)) == repr(moved)
    assert under(scene, None) is scene


class OneStage(Adapter):
    """As small as an adapter gets."""

    name = "one stage"
    dtype = np.float64

    def falloff(self, sigma: float) -> float:
        return float(np.exp(-sigma))


class Blending(Adapter):
    """Blending alone; the oracle projects and lists."""

    name = "blending"
    dtype = np.float64
    profile = None

    composite = staticmethod(composite)
    composite_vjp = staticmethod(composite_vjp)


class ForgetsBackground(Blending):
    def composite(self, splats: Any, lists: Any, *rest: Any) -> Any:  # type: ignore[override]
        width, height, tile_size, background, profile = rest
        return composite(splats, lists, width, height, tile_size, 0.0 * background, profile)


def test_a_stage_is_judged_through_an_adapter_of_a_few_lines() -> None:
    adapter = OneStage()
    judged = [path for path, law in LAWS.items() if not missing(adapter, law.needs)]
    assert judged == ["test_alpha:the_falloff_is_one_at_the_centre_and_multiplies_over_sums"]
    assert not broken(adapter, *judged)
    assert not adapter.has(RENDER)
    with pytest.raises(LookupError, match="one stage has no stage function sigma_at_pixel"):
        adapter.stage("sigma_at_pixel")


def test_blending_alone_is_judged_by_the_laws_of_images_and_gradients() -> None:
    adapter = Blending()
    assert adapter.has(RENDER)
    assert adapter.has(GRADIENTS)
    assert not broken(adapter, IMAGE, GRADIENT, BACKGROUND)
    assert broken(ForgetsBackground(), GRADIENT, BACKGROUND) == [BACKGROUND]


class ForgetsOpaqueSplats(Blending):
    def composite(self, splats: Any, lists: Any, *rest: Any) -> Any:  # type: ignore[override]
        return composite(splats, [[i for i in ids if splats.opacities[i] < 1.0] for ids in lists], *rest)


def test_a_failure_is_told_by_elimination_where_stages_are_hidden() -> None:
    seen = golden_scene()
    text = failure_report("test_some_law", ForgetsOpaqueSplats(), {"scene": seen})
    assert "no stage that its meta shows differs: depths, means2d, conics, so it is opacity" in text
    assert re.search(r"first pixel that differs: T_final, pixel \(\d+, \d+\): oracle 0\.\d+, backend 0\.\d+", text)
    assert "first Gaussian: as soon as Gaussian 1 is added to those in front of it" in text
    text = failure_report("test_some_law", ForgetsBackground(), {"scene": seen})
    assert "first Gaussian: as soon as there is no Gaussian: image, pixel (0, 0): oracle [0.125, 0.25, 0.5]" in text


def test_the_scene_that_is_told_is_the_first_that_differs() -> None:
    other = golden_scene().rows([0])
    text = failure_report("test_some_law", ForgetsOpaqueSplats(), {"one": other, "both": golden_scene()})
    assert text.endswith(scene_as_code(golden_scene()))
    text = failure_report("test_some_law", Blending(), {"one": other})
    assert "\npixels and gradients of its scenes are the oracle's; the law breaks in what it compares" in text
    assert "draws no scene" in failure_report("test_some_law", OneStage(), {})


def test_a_wrong_gradient_of_a_right_image_is_told() -> None:
    by_name = {mutant.name: mutant for mutant in MUTANTS}
    with living(by_name["conic_off_diagonal_twice"]) as backend:
        text = failure_report("test_some_law", backend, {"scene": golden_scene()})
    assert "first pixel" not in text
    assert re.search(r"first gradient that differs: v_scales, Gaussian \d, entry \[\d\]: oracle \S+, backend \S+", text)
    assert "nearest decision: D" in text


def test_an_adapter_is_found_by_its_path_and_must_be_one() -> None:
    assert made_by("tests.meta.test_backends:OneStage").has("falloff")
    with pytest.raises(ValueError, match="makes no adapter: it has no dtype, has, stage"):
        made_by("pathlib:Path")
    with pytest.raises(ValueError, match="must be written module:name"):
        made_by("tests.meta.test_backends")
    with pytest.raises(ValueError, match="has no function Nobody"):
        made_by("tests.meta.test_backends:Nobody")
    with pytest.raises(Unavailable, match=r"no_such\.module:Mine needs no_such, which is not installed"):
        made_by("no_such.module:Mine")


def test_a_scene_of_the_kit_is_a_public_name() -> None:
    assert isinstance(golden_scene(), Scene)


@pytest.mark.parametrize("name", ["compiled64", "compiled32"])
def test_what_the_compiled_backend_has_of_its_own_is_judged(name: str) -> None:
    backend = shipped_or_absent(name)
    if isinstance(backend, Absent):
        pytest.skip(backend.reason)
    own = ("tile_lists", "contributions", "sensitivities", "fisher_blocks", "dominant_points", "adam_step")
    assert [stage for stage in own if not backend.has(stage)] == []
    assert all("compiled" in backend._stage(stage).__module__ for stage in own[:-1])


def test_an_engines_own_adam_moves_what_strategies_edit(monkeypatch: pytest.MonkeyPatch) -> None:
    backend = shipped_or_absent("compiled32")
    if isinstance(backend, Absent):
        pytest.skip(backend.reason)
    law = law_named("test_strategies:a_training_by_gsplat_is_the_oracles_at_every_step")
    assert obeys(law, backend) is None
    # an engine that takes steps of half the length is no longer the oracle's, whatever torch's own Adam does
    module = importlib.import_module("pop_ref.conformance.torch_training")
    sound = module._step_by

    def halved(adam: Any, optimizer: Any) -> None:
        optimizer.param_groups[0]["lr"] *= 0.5
        sound(adam, optimizer)

    monkeypatch.setattr(module, "_step_by", halved)
    assert "training.rows" in (obeys(law, backend) or "")
