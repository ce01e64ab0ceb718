"""The adapters of the kit: what is not here is skipped with the reason, what is stands up to the laws.

Sound implementations that lack a piece, or add in another order, are not refused; and what fails is told about.
"""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from pop_fast.api.rasterize import rasterization as fast
from pop_ref.compositing import composite, composite_vjp
from pop_ref.conformance import Adapter, Scene, capabilities
from pop_ref.conformance.adapter import OracleAdapter, View, error_bounds_of, stage_function, under
from pop_ref.conformance.assertions import assert_same_image
from pop_ref.conformance.backends import (
    ELSEWHERE,
    Absent,
    Unavailable,
    function_named,
    made_by,
    require_a_picture,
    shipped,
    shipped_or_absent,
)
from pop_ref.conformance.failure_report import failure_report
from pop_ref.conformance.foreign_adapters import constants_of, inria
from pop_ref.conformance.law import missing
from pop_ref.conformance.laws.test_whole import test_an_empty_scene_is_the_background as empty_scene_law
from pop_ref.conformance.mutants import MUTANTS, living
from pop_ref.conformance.mutants.trial import every_law, law_named, obeys
from pop_ref.conformance.scenes import golden_scene, scene_as_code
from pop_ref.conformance.torch_adapter import TorchAdapter
from pop_ref.conformance.views import ASKED
from pop_ref.constants import GSPLAT_1_5, GSPLAT_1_6, INRIA, PAPER, PROFILES, Profile
from pop_ref.projection import project_means
from tests.judged import here

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


# diff-gaussian-rasterization's interface, as its users know it, on top of pop_fast. It insists on what Inria's code
# takes for granted: transposed matrices that belong together, unit quaternions, shapes.


class GaussianRasterizationSettings(NamedTuple):
    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool
    debug: bool
    antialiasing: bool


class GaussianRasterizer(torch.nn.Module):
    def __init__(self, raster_settings: GaussianRasterizationSettings) -> None:
        super().__init__()
        self.raster_settings = raster_settings

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        s = self.raster_settings
        n = len(means3D)
        assert (shs is None) != (colors_precomp is None)
        assert cov3D_precomp is None
        assert scales is not None
        assert rotations is not None
        assert means2D.shape == (n, 3)
        assert opacities.shape == (n, 1)
        # the kernels do not normalise
        assert torch.allclose(rotations.norm(dim=1), torch.ones_like(rotations[:, 0]), atol=1e-6)
        colors = shs if shs is not None else colors_precomp
        assert colors is not None
        given = (means3D, means2D, opacities, colors, scales, rotations)
        image, radii = _Drawn.apply(*given, s, shs is not None)
        return image, radii, torch.zeros_like(image[:1])


class _Drawn(torch.autograd.Function):
    """The render; its gradient of a screen centre is in halves of the image, as Inria's is."""

    @staticmethod
    def forward(ctx: Any, *given: Any) -> Any:
        *tensors, s, harmonics = given
        with torch.enable_grad():
            leaves = [tensor.detach().requires_grad_(True) for tensor in tensors]
            image, meta = _rasterized(leaves, s, harmonics)
        ctx.graph = image, [leaves[0], meta["means2d"], *leaves[2:]], (s.image_width, s.image_height)
        radii = meta["radii"][0].amax(dim=1).int()
        ctx.mark_non_differentiable(radii)
        return image[0].permute(2, 0, 1).detach(), radii

    @staticmethod
    def backward(ctx: Any, *v: Any) -> Any:
        image, wrt, size = ctx.graph
        v_means, v_points, *rest = torch.autograd.grad(
            image, wrt, v[0].permute(1, 2, 0)[None], allow_unused=True, materialize_grads=True
        )
        halves = v_points[0] * 0.5 * torch.tensor(size, dtype=v_points.dtype)
        return v_means, torch.nn.functional.pad(halves, (0, 1)), *rest, None, None


def _rasterized(leaves: list[Tensor], s: GaussianRasterizationSettings, harmonics: bool) -> tuple[Tensor, Any]:
    means, _, opacities, colors, scales, rotations = leaves
    viewmat = s.viewmatrix.T
    half = torch.tensor([0.5 * s.image_width, 0.5 * s.image_height], dtype=means.dtype)
    focal = half / torch.tensor([s.tanfovx, s.tanfovy], dtype=means.dtype)
    _check_camera(s, viewmat, focal, half)
    K = torch.eye(3, dtype=means.dtype)
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = *focal, *half
    image, _, meta = fast(
        means,
        rotations,
        scales * s.scale_modifier,
        opacities[:, 0],
        colors,
        viewmat[None],
        K[None],
        s.image_width,
        s.image_height,
        near_plane=INRIA.near_plane,
        sh_degree=s.sh_degree if harmonics else None,
        packed=False,
        backgrounds=s.bg[None],
        rasterize_mode="antialiased" if s.antialiasing else "classic",
        profile="inria",
    )
    return image, meta


def _check_camera(s: GaussianRasterizationSettings, viewmat: Tensor, focal: Tensor, half: Tensor) -> None:
    # a point through the projection matrix lands where the pinhole puts it, and the camera stands at campos
    there = torch.tensor([0.3, -0.2, 2.0, 1.0], dtype=viewmat.dtype)
    world = torch.linalg.solve(viewmat, there)
    clip = world @ s.projmatrix
    assert torch.allclose(clip[:2] / clip[3] * half + half, focal * there[:2] / there[2] + half, atol=1e-3)
    assert torch.allclose(viewmat[:3, :3] @ s.campos, -viewmat[:3, 3], rtol=1e-4, atol=1e-4)


STUB = SimpleNamespace(
    GaussianRasterizationSettings=GaussianRasterizationSettings, GaussianRasterizer=GaussianRasterizer
)


def test_a_rasterizer_that_needs_a_gpu_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "diff_gaussian_rasterization", STUB)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    reason = shipped_or_absent("diff-gaussian-rasterization").reason
    assert reason == "diff-gaussian-rasterization needs a CUDA device, and torch finds none"


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_inrias_interface_is_judged_through_its_adapter(dtype: str) -> None:
    adapter = inria("stub", STUB, dtype, "cpu")
    assert not broken(adapter)
    assert not missing(adapter, (capabilities.RENDER, capabilities.GRADIENTS, capabilities.INRIAS))
    assert missing(
        adapter, (capabilities.PROFILES, capabilities.EXTENTS, capabilities.DERIVATIVES, capabilities.LOWER_CEILING)
    )
    g = adapter.gradients(adapter.sees(golden_scene()), np.ones((16, 16, 3)), np.zeros((16, 16)))
    assert set(g) == {"means", "quats", "scales", "opacities", "sh", "means2d"}


def _changed(change: Callable[[Any], dict[str, Any]]) -> SimpleNamespace:
    """Return the stub with other settings than the adapter gave it."""

    def settings(**given: Any) -> Any:
        made = GaussianRasterizationSettings(**given)
        return made._replace(**change(made))

    settings._fields = GaussianRasterizationSettings._fields  # type: ignore[attr-defined]
    return SimpleNamespace(GaussianRasterizationSettings=settings, GaussianRasterizer=GaussianRasterizer)


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
        options["near_plane"] = PROFILES[profile].near_plane
        options["rasterize_mode"] = rasterize_mode
        image, alphas, meta = sound(*args, profile=profile, **options)
        return image, alphas, {"means2d": meta["means2d"], "radii": meta["radii"]}

    return TorchAdapter(f"fixed {profile}", rasterization, profile=PROFILES[profile])


def test_a_version_of_gsplat_that_is_no_release_has_constants() -> None:
    of = [constants_of(version) for version in ("1.5.3+pt24", "1.6rc1", "2.0a1", "1.10.0")]
    assert of == [GSPLAT_1_5, GSPLAT_1_6, GSPLAT_1_6, GSPLAT_1_6]


@pytest.mark.parametrize("profile", ["gsplat_1_6", "inria"])
def test_a_rasterizer_with_one_profile_is_judged_under_it(profile: str) -> None:
    adapter = fixed(profile)
    assert not broken(adapter)
    assert adapter.sees(golden_scene()).profile == PROFILES[profile]


def test_a_rasterizer_that_lacks_an_argument_is_not_handed_its_own_constant() -> None:
    def rasterization(means: Any, quats: Any, scales: Any, opacities: Any, colors: Any, viewmats: Any, Ks: Any,
                      width: int, height: int, sh_degree: Any = None, backgrounds: Any = None) -> Any:  # fmt: skip
        options = {"sh_degree": sh_degree, "backgrounds": backgrounds, "profile": "inria", "packed": False}
        return sound(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **options)

    backend = TorchAdapter("Inria's", rasterization, profile=INRIA)
    assert backend.first_error() is None
    assert "near_plane" in str(backend.why_not(capabilities.PLANES))
    assert not broken(backend, SQUARE)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda images, meta: (images.permute(0, 3, 1, 2), meta),
         "images have shape [1, 3, 16, 16]; they must be [cameras, 16, 16, channels]"),
        (lambda images, meta: (images, {"radii": meta["radii"][..., 0]}),
         "meta['radii'] has shape [1, 10]; of one camera it must be [1, 10, 2]"),
    ],
    ids=["channels first", "one radius"],
)  # fmt: skip
def test_an_image_or_meta_of_another_shape_is_told_by_name(change: Callable[..., Any], said: str) -> None:
    def rasterization(*args: Any, **options: Any) -> Any:
        images, alphas, meta = sound(*args, **options)
        images, meta = change(images, meta)
        return images, alphas, meta

    with pytest.raises(ValueError, match=re.escape(said)):
        TorchAdapter("strange", rasterization).render(golden_scene())


def test_a_pixel_that_differs_is_told_by_its_place_and_an_image_of_another_shape_by_its_shape() -> None:
    class Transposed(Blending):
        def composite(self, splats: Any, lists: Any, *rest: Any) -> Any:  # type: ignore[override]
            found = composite(splats, lists, *rest)
            return SimpleNamespace(image=found.image.swapaxes(0, 1), T_final=found.T_final)

    scene = golden_scene().with_overrides(width=20)
    expected, wrong = (adapter.render(scene).image for adapter in (Blending(), Transposed()))
    sure, of = np.ones((16, 20), dtype=bool), error_bounds_of(scene, np.float64)
    bounds: Any = SimpleNamespace(unambiguous=sure, image=of.image, absolute=of.absolute)
    with pytest.raises(AssertionError, match=re.escape("shape (20, 16, 3), expected (16, 20, 3)")):
        assert_same_image("agreement.image", Blending(), wrong, expected, bounds)
    sure[0] = False
    changed = expected.copy()
    changed[0, 1:] += 1.0
    changed[5, 7, 2] += 1.0
    with pytest.raises(AssertionError, match=re.escape("first at [5, 7, 2]: got")):
        assert_same_image("agreement.image", Blending(), changed, expected, bounds)


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


class InWords(OneStage):
    dtype = "float64"


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
    assert not adapter.has(capabilities.RENDER)
    with pytest.raises(LookupError, match="one stage has no stage function sigma_at_pixel"):
        adapter.stage("sigma_at_pixel")


def test_blending_alone_is_judged_by_the_laws_of_images_and_gradients() -> None:
    adapter = Blending()
    assert adapter.has(capabilities.RENDER)
    assert adapter.has(capabilities.GRADIENTS)
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
    assert "first stage" not in text
    assert re.search(r"first gradient that differs: v_scales, Gaussian \d, entry \[\d\]: oracle \S+, backend \S+", text)
    assert "nearest decision: D" in text


def test_an_adapter_is_found_by_its_path_and_must_be_one() -> None:
    assert made_by("tests.meta.test_backends:OneStage").has("falloff")
    with pytest.raises(ValueError, match=r"has dtype 'float64'; it must be np\.float32 or np\.float64"):
        made_by("tests.meta.test_backends:InWords")
    assert function_named("pathlib:Path.home") == Path.home
    with pytest.raises(ValueError, match=r"module pathlib has no function Nobody\.home"):
        function_named("pathlib:Nobody.home")


@pytest.mark.parametrize("name", ["compiled64", "compiled32"])
def test_what_the_compiled_backend_has_of_its_own_is_judged(name: str) -> None:
    backend = here(name)
    own = ("tile_lists", "contributions", "sensitivities", "fisher_blocks", "dominant_points", "adam_step")
    assert [stage for stage in own if not backend.has(stage)] == []
    assert all("compiled" in backend._stage(stage).__module__ for stage in own[:-1])


@pytest.mark.parametrize("name", ["compiled32"])
def test_an_engines_own_adam_moves_what_strategies_edit(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    backend = here(name)
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


sound = partial(fast, backend="fast")
TWICE = "test_gradients:twice_the_cotangent_is_exactly_twice_the_gradient"
SCALED = "test_whole:scaling_the_world_by_a_power_of_two_changes_no_bit"


def only_drawing(*args: Any, **options: Any) -> Any:
    with torch.no_grad():
        return sound(*args, **options)


def leaving_torch(means: Any, *args: Any, **options: Any) -> Any:
    return sound(torch.as_tensor(means.numpy()), *args, **options)


@pytest.mark.parametrize("rasterization", [only_drawing, leaving_torch])
def test_a_rasterizer_that_only_draws_is_judged_by_its_images(rasterization: Callable[..., Any]) -> None:
    backend = TorchAdapter("drawing", rasterization, dtype="float32")
    assert backend.has(capabilities.RENDER)
    assert not backend.has(capabilities.GRADIENTS)
    of_gradients = [stated for stated in LAWS.values() if capabilities.GRADIENTS in stated.needs]
    assert len(of_gradients) > 15
    assert all(capabilities.GRADIENTS in missing(backend, stated.needs) for stated in of_gradients)
    # the laws of the signature compare its images all the same
    cameras = law_named("test_signature_arguments:several_cameras_in_one_call_see_what_each_sees_alone")
    assert not missing(backend, cameras.needs)
    assert obeys(cameras, backend) is None


def test_a_gradient_that_fails_is_a_failure_and_not_a_missing_piece() -> None:
    def broken(*args: Any, **options: Any) -> Any:
        raise RuntimeError("illegal memory access")

    with pytest.raises(RuntimeError, match="illegal memory access"):
        TorchAdapter("broken", broken).has(capabilities.GRADIENTS)


def two_values(*args: Any, **options: Any) -> Any:
    return sound(*args, **options)[:2]


def writing_over(means: Any, *args: Any, **options: Any) -> Any:
    means += 0.0
    return sound(means, *args, **options)


def failing_with_gradients(means: Any, *args: Any, **options: Any) -> Any:
    if means.requires_grad:
        raise RuntimeError("no backward kernel")
    return sound(means, *args, **options)


@pytest.mark.parametrize(
    ("rasterization", "said"),
    [(two_values, "expected 3, got 2"), (writing_over, "in-place"), (failing_with_gradients, "no backward kernel")],
)
def test_an_answer_that_no_law_can_read_is_told_in_a_line_before_they_run(rasterization: Any, said: str) -> None:
    with pytest.raises(ValueError, match=f"a first small picture raises .*{said}"):
        require_a_picture(TorchAdapter("odd", rasterization))


def ids_alone(*args: Any, **options: Any) -> Any:
    image, alphas, meta = sound(*args, dominance=True, **options)
    return image, alphas, {"dominant_ids": meta["dominant_ids"]}


def test_dominant_ids_are_judged_without_weights_and_counts() -> None:
    backend = TorchAdapter("ids", ids_alone, dtype="float32")
    assert backend.has(capabilities.DOMINANCE)
    assert not backend.has(capabilities.DOMINANT_WEIGHTS)
    judged = [path for path, s in LAWS.items() if capabilities.DOMINANCE in s.needs and not missing(backend, s.needs)]
    assert len(judged) >= 6
    assert {path: broken for path in judged if (broken := obeys(LAWS[path], backend, 10))} == {}


def _refuses_packed(alone: Callable[[], Any], with_backgrounds: Callable[[], Any] | None = None) -> Callable[..., Any]:
    def rasterization(*args: Any, packed: bool = True, backgrounds: Any = None, **options: Any) -> Any:
        if packed:
            return alone() if backgrounds is None or with_backgrounds is None else with_backgrounds()
        return sound(*args, packed=False, backgrounds=backgrounds, **options)

    return rasterization


def _raises(error: Exception) -> Any:
    raise error


def _asserts() -> None:
    allowed = False
    assert allowed, "packed rows come later"


def _states() -> Any:
    return _raises(NotImplementedError("packed"))


def without_packed(means: Any, quats: Any, scales: Any, opacities: Any, colors: Any, viewmats: Any, Ks: Any,
                   width: int, height: int, sh_degree: int | None = None, backgrounds: Any = None) -> Any:  # fmt: skip
    return sound(means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree=sh_degree,
                 backgrounds=backgrounds, packed=False)  # fmt: skip


REFUSALS: dict[str, Callable[..., Any]] = {
    "not implemented": _refuses_packed(lambda: _raises(NotImplementedError("packed"))),
    "a ValueError by a statement": _refuses_packed(lambda: _raises(ValueError("packed=True is not for me"))),
    "words of compiled code": _refuses_packed(lambda: _raises(RuntimeError("packed mode is not supported"))),
    "no such argument": without_packed,
    "a statement, and an assertion with backgrounds": _refuses_packed(_states, _asserts),
}
DEFECTS: dict[str, Callable[..., Any]] = {
    "an assertion": _refuses_packed(_asserts),
    "an operation on types that have none": _refuses_packed(lambda: {} | ()),  # type: ignore[operator]
    "arrays that do not fit": _refuses_packed(lambda: np.zeros(2) + np.zeros(3)),
    "a key that is not there": _refuses_packed(lambda: {}["packed"]),
    "an argument of something inside": _refuses_packed(lambda: dict.fromkeys(values=())),  # type: ignore[call-arg]
    "an assertion, and a statement with backgrounds": _refuses_packed(_asserts, _states),
    "a kernel that fails": _refuses_packed(lambda: _raises(RuntimeError("illegal memory access"))),
}
PACKED_LAW = "test_signature_arguments:packed_rows_are_those_of_the_visible_gaussians_and_draw_the_same"


@pytest.mark.parametrize("words", REFUSALS)
def test_what_is_refused_on_purpose_is_skipped_in_the_words_of_the_refusal(words: str) -> None:
    backend = TorchAdapter("refusing", REFUSALS[words], dtype="float32")
    assert missing(backend, law_named(PACKED_LAW).needs) == [capabilities.PACKED]
    assert "packed" in str(backend.why_not(capabilities.PACKED))


def test_a_rasterizer_with_fewer_arguments_than_gsplats_is_judged_by_those_it_has() -> None:
    backend = TorchAdapter("short", without_packed, dtype="float32")
    for path in (
        "test_agreement:the_image_is_one_of_the_oracles_outcomes",
        "test_signature_arguments:several_cameras_in_one_call_see_what_each_sees_alone",
    ):
        assert not missing(backend, law_named(path).needs)
        assert obeys(law_named(path), backend, 5) is None


@pytest.mark.parametrize("defect", DEFECTS)
def test_an_error_that_nobody_raised_on_purpose_is_a_defect_that_a_law_reports(defect: str) -> None:
    backend = TorchAdapter("crashing", DEFECTS[defect], dtype="float32")
    assert not missing(backend, law_named(PACKED_LAW).needs)
    assert obeys(law_named(PACKED_LAW), backend, 5) is not None


class _Unordered(torch.autograd.Function):
    """A sum whose gradient is taken in an order that another run does not repeat: its last bit varies."""

    run = 0

    @staticmethod
    def forward(ctx: Any, value: Any) -> Any:
        return value.clone()

    @staticmethod
    def backward(ctx: Any, v: Any) -> Any:
        _Unordered.run += 1
        return v * (1.0 + (_Unordered.run % 3) * torch.finfo(v.dtype).eps)


def unordered(means: Any, *args: Any, **options: Any) -> Any:
    return sound(_Unordered.apply(means), *args, **options)


def test_sums_without_an_order_are_not_held_to_equal_bits() -> None:
    assert obeys(law_named(TWICE), TorchAdapter("careless", unordered, dtype="float32"), 10) is not None
    backend = TorchAdapter("atomic", unordered, dtype="float32", deterministic=False)
    skipped = {path for path, stated in LAWS.items() if capabilities.DETERMINISTIC in missing(backend, stated.needs)}
    assert {TWICE, "test_gradients:gradients_ignore_the_coefficients_of_other_bands"} <= skipped
    assert "test_agreement:gradients_are_the_oracles" not in skipped
    assert obeys(law_named("test_agreement:gradients_are_the_oracles"), backend, 10) is None


class OneProfile(Adapter):
    """An author's adapter: the oracle's stages as methods, and an error for constants that it does not have."""

    name, dtype, profile = "one profile", np.float64, GSPLAT_1_5

    def __getattr__(self, name: str) -> Any:
        function = stage_function("pop_ref", name)
        if function is None:
            raise AttributeError(name)

        def checked(*args: Any, **options: Any) -> Any:
            for value in (*args, *options.values()):
                if isinstance(value, Profile):
                    assert {**vars(value), "name": ""} == {**vars(GSPLAT_1_5), "name": ""}, f"handed {value.name}"
            return function(*args, **options)

        return checked


@pytest.mark.parametrize("stage", ["projection", "camera", "alpha", "footprint", "tiles"])
def test_an_adapter_of_one_profile_is_handed_no_other(stage: str) -> None:
    backend = OneProfile()
    judged = {path: s for path, s in LAWS.items() if s.stage == stage and not missing(backend, s.needs)}
    assert len(judged) >= 4
    assert {path: broken for path, s in judged.items() if (broken := obeys(s, backend, 20))} == {}


class InriasDivision(OracleAdapter):
    """The oracle with Inria's divisor w + 1e-7, which a world of another size meets elsewhere."""

    def render(self, scene: Scene) -> View:
        R, t = scene.camera.viewmat[:3, :3], scene.camera.viewmat[:3, 3]
        p = scene.gaussians.means @ R.T + t
        aside = p * np.array([1.0, 1.0, 0.0]) * (p[:, 2:] / (p[:, 2:] + 1e-7) - 1.0)
        return super().render(scene.with_overrides(means=scene.gaussians.means + aside @ R))


def test_inrias_divisor_breaks_no_law_of_its_profile() -> None:
    backend = InriasDivision()
    assert obeys(law_named(SCALED), backend) is not None
    backend.profile = INRIA
    assert Adapter.has(backend, capabilities.HOMOGENEOUS) is False
    assert capabilities.HOMOGENEOUS in law_named(SCALED).needs


class Greyish(OracleAdapter):
    """The oracle with a background that is a little too bright."""

    def render(self, scene: Scene) -> View:
        return super().render(scene.with_overrides(background=scene.background + 2.0**-10))


def test_an_empty_scene_has_a_report() -> None:
    with pytest.raises(AssertionError) as caught:
        empty_scene_law(Greyish())
    report = "\n".join(caught.value.__notes__)
    assert "no report" not in report
    assert "first pixel that differs: image, pixel (0, 0)" in report
    no_gaussians = golden_scene().rows([])
    assert "no report" not in failure_report("test_some_law", OracleAdapter(), {"scene": no_gaussians})


class WrongGradients(OracleAdapter):
    """The oracle with a wrong gradient of the background."""

    def gradients(self, scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, np.ndarray]:
        found = super().gradients(scene, v_image, v_T_final)
        return found | {"background": found["background"] + 1.0}


def test_a_law_that_asked_for_no_gradient_is_not_explained_by_one() -> None:
    backend = WrongGradients()
    assert "first gradient that differs: v_background" in failure_report(
        "test_some_law", backend, {"scene": golden_scene()}
    )
    backend.asked_for_gradients = False  # type: ignore[attr-defined]
    report = failure_report("test_some_law", backend, {"scene": golden_scene()})
    assert "gradient" not in report
    assert "the law breaks in what it compares" in report


def refusing(*args: Any, render_mode: str = "RGB", radius_clip: float = 0.0, **options: Any) -> Any:
    if render_mode != "RGB":
        raise NotImplementedError("no depth")
    if radius_clip:
        raise ValueError("radius_clip must be 0")
    return sound(*args, **options)


def bare(means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane=0.01, eps2d=0.3,
         sh_degree=None, packed=True, tile_size=16, backgrounds=None):  # fmt: skip
    named = {"sh_degree": sh_degree, "packed": packed, "tile_size": tile_size, "backgrounds": backgrounds}
    planes = {"near_plane": near_plane, "eps2d": eps2d}
    return sound(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **planes, **named)


def test_an_argument_that_is_refused_or_not_there_is_a_skip_by_name() -> None:
    lacks = {
        refusing: {"depth modes", "radius_clip"},
        bare: {
            "depth modes",
            "radius_clip",
            "covariances in place of quaternions and scales",
            "planes and low-pass other than its defaults",
        },
    }
    for rasterization, expected in lacks.items():
        backend = TorchAdapter("partial", rasterization, dtype="float32")
        assert {name for name in ASKED if not backend.has(name)} == expected | {"sparse_grad"}
        assert backend.has(capabilities.GRADIENTS), "an argument absgrad is no condition of gradients"


def of_one_profile(profile: Profile) -> Any:
    """Give a rasterizer that has the constants of one profile, and no argument to choose another."""

    def rasterization(means: Any, quats: Any, scales: Any, opacities: Any, colors: Any, viewmats: Any, Ks: Any,
                      width: int, height: int, packed: bool = True, render_mode: str = "RGB", absgrad: bool = False,
                      covars: Any = None, **options: Any) -> Any:  # fmt: skip
        given = {"packed": packed, "render_mode": render_mode, "absgrad": absgrad, "covars": covars, **options}
        return sound(
            means, quats, scales, opacities, colors, viewmats, Ks, width, height, profile=profile.name, **given
        )

    return TorchAdapter(profile.name, rasterization, dtype="float32", profile=profile)


@pytest.mark.slow  # all laws of the signature
@pytest.mark.parametrize("profile", [GSPLAT_1_6, INRIA], ids=lambda profile: profile.name)
def test_the_laws_of_the_signature_and_of_scale_judge_constants_of_any_profile(profile: Profile) -> None:
    backend, judged = of_one_profile(profile), 0
    for path, stated in LAWS.items():
        if path.startswith(("test_signature", "test_scale")) and not missing(backend, stated.needs):
            assert obeys(stated, backend) is None, path
            judged += 1
    assert judged >= (24 if profile is INRIA else 36)
