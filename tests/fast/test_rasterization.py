"""The drop-in's own promises: shapes, modes, batches, laziness, memory; the laws judge its numbers."""

from __future__ import annotations

import inspect
import re
from dataclasses import replace
from enum import Enum
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
import torch.utils._pytree
import torch.utils.checkpoint
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from pop_fast.api.backend import backend_names, fastest_backend, get_backend
from pop_fast.api.backends import FAST
from pop_fast.api.checks import Checks
from pop_fast.api.rasterize import RenderMeta
from pop_fast.api.rasterize import rasterization as program
from pop_fast.errors import PopError
from pop_fast.stages import blend
from pop_ref.constants import PAPER
from tests.app.tiny import skip_without

WIDTH, HEIGHT, N = 21, 18, 24


# fmt: off
GSPLAT_META = {
    "means2d", "radii", "depths", "conics", "opacities", "camera_ids", "gaussian_ids", "batch_ids", "tile_width",
    "tile_height", "tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets", "width", "height", "tile_size",
    "n_batches", "n_cameras",
}
# fmt: on

# what is promised to the bit is promised of this backend
rasterization = partial(program, backend="fast")


def scene(seed: int = 0, dtype: torch.dtype = torch.float64, n: int = N, channels: int = 3) -> dict[str, Tensor]:
    rng = np.random.default_rng(seed)
    made = {
        "means": rng.normal(size=(n, 3)) * [1.0, 0.8, 0.6] + [0.0, 0.0, 3.0],
        "quats": rng.normal(size=(n, 4)),
        "scales": np.exp(rng.normal(size=(n, 3)) * 0.5 - 1.6),
        "opacities": rng.uniform(size=n),
        "colors": rng.uniform(size=(n, channels)),
    }
    return {name: torch.tensor(value, dtype=dtype) for name, value in made.items()}


def cameras(count: int = 1, dtype: torch.dtype = torch.float64) -> dict[str, Tensor | int]:
    viewmats = torch.eye(4, dtype=dtype).repeat(count, 1, 1)
    viewmats[:, 0, 3] = torch.arange(count, dtype=dtype) * 0.25
    K = torch.tensor([[20.0, 0.0, 10.25], [0.0, 20.0, 9.5], [0.0, 0.0, 1.0]], dtype=dtype)
    return {"viewmats": viewmats, "Ks": K.repeat(count, 1, 1), "width": WIDTH, "height": HEIGHT}


@pytest.mark.parametrize("backend", ["fast", "compiled"])
def test_a_loss_that_goes_back_inside_autocast_has_the_same_gradients(backend: str) -> None:
    def gradients(inside: bool) -> list[Tensor]:
        given = {name: value.float() for name, value in scene().items()}
        given |= {"colors": torch.rand((N, 9, 3), generator=torch.Generator().manual_seed(0)) - 0.5}
        seen = cameras(dtype=torch.float32)
        given["viewmats"] = seen.pop("viewmats")
        leaves = {name: value.requires_grad_() for name, value in given.items()}
        image = program(**leaves, **seen, sh_degree=2, backend=backend)[0]
        with torch.autocast("cpu", enabled=inside):
            (image * torch.linspace(-1.0, 1.0, image.numel()).view_as(image)).sum().backward()
        return [value.grad for value in leaves.values()]

    skip_without(backend)
    assert all(map(torch.equal, gradients(True), gradients(False)))


ON_THE_CPU = ("fast", "compiled", "ref")


@pytest.mark.parametrize("backend", ON_THE_CPU)
def test_what_is_drawn_in_another_mode_of_torch_leaves_the_rest_as_it_is(backend: str) -> None:
    skip_without(backend)
    blend.clear_buffers()
    single = {name: value.float() for name, value in scene(n=8).items()}
    drawn = partial(program, **cameras(dtype=torch.float32), backend=backend)
    for mode in (torch.inference_mode(), torch.autocast("cpu")):
        with mode:
            meta = drawn(**single)[2]
            counts = meta["dominant_counts"]
        plain = drawn(**single)[2]
        assert torch.equal(counts, plain["dominant_counts"])
        assert torch.equal(meta["n_contrib"], plain["n_contrib"])
        leaves = {name: value.clone().requires_grad_() for name, value in single.items()}
        drawn(**leaves)[0].square().sum().backward()


@pytest.mark.parametrize("backend", ON_THE_CPU)
def test_what_is_written_to_inputs_before_the_way_back_changes_no_gradient_in_silence(backend: str) -> None:
    skip_without(backend)

    def gradients(written: str | None) -> list[Tensor]:
        given = {**scene(n=8), **cameras()}
        leaves = [given[name].requires_grad_() for name in scene()]
        image, alphas, _ = program(**given, backend=backend)
        if written is not None:
            given[written].detach().mul_(0.75)
        return list(torch.autograd.grad(image.square().sum() + alphas.sum(), leaves))

    once = gradients(None)
    for name in (*scene(), "viewmats", "Ks"):
        try:
            found = gradients(name)
        except RuntimeError:
            # autograd's own, of what it has saved
            found = once if name != "Ks" else []
        assert found, name
        assert all(map(torch.equal, once, found)), name


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("backend", ON_THE_CPU)
def test_an_image_and_alphas_may_be_written_to(backend: str, packed: bool) -> None:
    skip_without(backend)

    def gradients(written: bool) -> list[Tensor]:
        given = {name: value.requires_grad_() for name, value in scene(n=8).items()}
        image, alphas, _ = program(**given, **cameras(), packed=packed, backend=backend)
        # as gsplat's trainer leaves pixels out, and as it does not
        image = image.clamp_(0.1, 0.4) if written else image.clamp(0.1, 0.4)
        alphas = alphas.mul_(0.5) if written else 0.5 * alphas
        return list(torch.autograd.grad(image.square().sum() + alphas.square().sum(), list(given.values())))

    assert all(map(torch.equal, gradients(True), gradients(False)))


@pytest.mark.parametrize("backend", ON_THE_CPU)
def test_second_derivatives_are_refused_where_first_ones_of_a_checkpoint_are_right(backend: str) -> None:
    skip_without(backend)
    rows = scene(n=8)
    means = rows.pop("means").requires_grad_()

    def total(means: Tensor) -> Tensor:
        return program(means, **rows, **cameras(), backend=backend)[0].sum()

    (once,) = torch.autograd.grad(total(means), means)
    again = torch.utils.checkpoint.checkpoint(total, means, use_reentrant=False)
    assert torch.equal(torch.autograd.grad(again, means)[0], once)
    # the cotangent of a sum requires no gradient
    with pytest.raises(RuntimeError, match="no second derivatives"):
        torch.autograd.functional.hessian(total, means)


@pytest.mark.parametrize("backend", ON_THE_CPU)
@pytest.mark.parametrize("norm", [1e-25, 1e25])
def test_quaternions_have_any_norm(backend: str, norm: float) -> None:
    skip_without(backend)
    given = {name: value.float() for name, value in scene().items()}
    images, gradients = [], []
    for factor in (1.0, norm):
        quats = (given["quats"] * factor).requires_grad_()
        images.append(program(**{**given, "quats": quats}, **cameras(dtype=torch.float32), backend=backend)[0])
        images[-1].square().sum().backward()
        gradients.append(quats.grad.double() * factor)
    torch.testing.assert_close(*images)
    torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("backend", ON_THE_CPU)
def test_a_compiled_step_calls_the_renderer_as_it_is(backend: str) -> None:
    skip_without(backend)
    rows = scene(n=8)

    def step(means: Tensor) -> tuple[Tensor, Tensor]:
        image, _, meta = program(means, **rows, **cameras(), backend=backend)
        return image.square().mean(), meta["dominant_counts"]

    means, found, graphs = rows.pop("means").requires_grad_(), [], []

    def kept(graph: Any, _: Any) -> Any:
        graphs.append(graph)
        return graph.forward

    torch.compiler.reset()
    for function in (step, torch.compile(step, backend=kept)):
        loss, counts = function(means)
        found.append((loss, counts, *torch.autograd.grad(loss, means)))
    assert all(map(torch.equal, *found))
    # the cameras, and what the step does with the image: of the renderer there would be dozens
    assert len(graphs) <= 3


@pytest.mark.parametrize("backend", ON_THE_CPU)
def test_colours_may_have_no_channel(backend: str) -> None:
    skip_without(backend)
    given = scene(channels=0)
    given["opacities"].requires_grad_()
    image, alphas, _ = program(**given, **cameras(), backend=backend)
    assert image.shape == (1, HEIGHT, WIDTH, 0)
    alphas.sum().backward()
    assert bool((given["opacities"].grad != 0.0).any())


def test_packed_rows_cameras_and_batches_have_the_bits_of_each_alone() -> None:
    first, second, two = scene(1), scene(2), cameras(2)
    alone, _, meta = rasterization(**first, **two, packed=False)
    packed, _, of_packed = rasterization(**first, **two, packed=True)
    assert torch.equal(packed, alone)
    for key in ("dominant_ids", "dominant_counts"):
        assert torch.equal(of_packed[key], meta[key])
    rows = of_packed["camera_ids"], of_packed["gaussian_ids"]
    assert torch.equal(meta["means2d"][rows], of_packed["means2d"])
    for i in range(2):
        one = {**two, "viewmats": two["viewmats"][i : i + 1], "Ks": two["Ks"][:1]}
        assert torch.equal(rasterization(**first, **one)[0][0], alone[i])
    batched = {name: torch.stack((first[name], second[name])) for name in first}
    views = {**two, "viewmats": two["viewmats"].repeat(2, 1, 1, 1), "Ks": two["Ks"].repeat(2, 1, 1, 1)}
    images, alphas, of_batches = rasterization(**batched, **views, packed=False)
    assert alphas.shape == (2, 2, HEIGHT, WIDTH, 1)
    assert of_batches["dominant_counts"].shape == (2, 2, N)
    assert torch.equal(images, torch.stack((alone, rasterization(**second, **two)[0])))


def test_instruments_read_later_equal_instruments_asked_for() -> None:
    given = scene()
    _, _, meta = rasterization(**given, **cameras(2), dominance=True, counts=True)
    _, _, other = rasterization(**given, **cameras(2))
    for key in ("dominant_ids", "dominant_counts", "n_contrib", "n_traversed"):
        assert torch.equal(meta[key], other[key]), key
    # counting blends in the tiles that were asked for, which rounds differently
    torch.testing.assert_close(meta["dominant_weights"], other["dominant_weights"], rtol=1e-12, atol=1e-14)
    pixels = meta["dominant_counts"].sum(1) + (meta["dominant_ids"] < 0).sum((1, 2))
    assert pixels.tolist() == [WIDTH * HEIGHT] * 2


def test_two_runs_and_a_second_backward_pass_give_the_same_bits() -> None:
    def gradients(backwards: int = 1) -> list[Tensor]:
        leaves = {name: value.requires_grad_() for name, value in scene(3).items()}
        loss = rasterization(**leaves, **cameras())[0].square().sum()
        for _ in range(backwards):
            found = torch.autograd.grad(loss, list(leaves.values()), retain_graph=True)
        return list(found)

    once = gradients()
    assert all(g.abs().sum() > 0.0 for g in once)
    for again in (gradients(), gradients(2)):
        assert all(torch.equal(a, b) for a, b in zip(once, again, strict=True))


def test_buffers_are_reused_and_can_be_freed() -> None:
    leaf = scene(4)["means"].requires_grad_()
    rasterization(**{**scene(4), "means": leaf}, **cameras())[0].sum().backward()
    taken = blend.acquire_buffer(64, torch.float64)
    blend.release_buffer(taken)
    assert blend.acquire_buffer(64, torch.float64).data_ptr() == taken.data_ptr()
    assert blend._pool.retained > 0
    blend.clear_buffers()
    assert blend._pool.retained == 0


@pytest.mark.parametrize("compiled", [False, True])
def test_auto_is_the_default_and_takes_the_fastest_that_is_there(compiled, monkeypatch):
    from pop_fast import compiled as kernels
    from pop_fast.api.backends import CompiledBackend

    asked: list[str] = []
    monkeypatch.setattr(kernels, "why_not", lambda: None if compiled else "not compiled")
    monkeypatch.setattr(CompiledBackend, "stages", lambda self: (asked.append(self.name), FAST.stages())[1])
    image = program(**scene(), **cameras())[0]
    assert asked == ["compiled"] * compiled
    assert torch.equal(image, rasterization(**scene(), **cameras())[0])
    assert inspect.signature(program).parameters["backend"].default == "auto"


def test_auto_says_why_no_backend_draws_on_a_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cuda_ext.why_not", lambda: None)
    assert fastest_backend("cuda").name == "cuda"
    monkeypatch.setattr("cuda_ext.why_not", lambda: "there is none")
    with pytest.raises(PopError, match="backend 'cuda' cannot run: there is none"):
        fastest_backend("cuda")
    with pytest.raises(PopError, match="no backend renders tensors on 'meta'"):
        program(**{name: tensor.to("meta") for name, tensor in scene().items()}, **cameras())


def harmonics() -> dict[str, object]:
    return {**scene(), **cameras(2), "colors": torch.ones((N, 4, 3), dtype=torch.float64), "sh_degree": 1}


ASKED: dict[str, dict[str, Any]] = {
    "unpacked": {"packed": False, "absgrad": True, "channel_chunk": 8},
    "packed": {"packed": True},
    "colours": {"colors": torch.ones((N, 5), dtype=torch.float64), "sh_degree": None},
    "depth": {"render_mode": "RGB+ED", "packed": False},
    "antialiased": {"rasterize_mode": "antialiased"},
    "inria": {"profile": "inria"},
    "a background": {"backgrounds": torch.rand((2, 3), dtype=torch.float64)},
    # with gradients
    "pixels that stop": {"opacities": torch.ones(N, dtype=torch.float64), "scales": 4.0 * scene()["scales"]},
}


@pytest.mark.parametrize("name", ASKED)
def test_the_oracle_renders_behind_the_same_arguments(name: str) -> None:
    given, gradients = {**harmonics(), **ASKED[name]}, []
    leaves = [given[key].requires_grad_(name == "pixels that stop") for key in scene()]
    expected = rasterization(**given)
    image, alphas, meta = program(**given, backend="ref")
    if name == "pixels that stop":
        for image_of, alphas_of, meta_of in (expected, (image, alphas, meta)):
            wanted = [*leaves, meta_of["means2d"]]
            gradients.append(torch.autograd.grad(image_of.square().sum() + alphas_of.sum(), wanted))
        torch.testing.assert_close(*gradients, rtol=1e-10, atol=1e-9)
    assert image.std() > 0.0
    torch.testing.assert_close(image, expected[0], rtol=0, atol=1e-11)
    torch.testing.assert_close(alphas, expected[1], rtol=0, atol=1e-11)
    assert set(meta) == set(expected[2]) - {"n_pairs"}
    for key, value in meta.items():
        if isinstance(value, torch.Tensor):
            # what is culled has no place on the screen for the oracle
            shown = (meta["radii"] > 0).all(-1) if key in ("means2d", "conics", "opacities") else ...
            torch.testing.assert_close(value[shown], expected[2][key][shown], rtol=1e-9, atol=1e-9, check_dtype=False)


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ({"radius_clip": 3.0}, "radius_clip=3.0 is not supported by backend 'ref': the oracle culls by extents alone"),
        ({"covars": torch.ones(N, 3, 3)}, f"covars=a tensor of shape [{N}, 3, 3] is not supported by backend 'ref'"),
    ],
    ids=["radius_clip", "covars"],
)
def test_what_the_oracle_does_not_offer_is_said_in_one_line(argument: dict[str, object], said: str) -> None:
    with pytest.raises(NotImplementedError, match=re.escape(said)) as caught:
        program(**{**harmonics(), **argument}, backend="ref")
    assert "\n" not in str(caught.value)
    with pytest.raises(TypeError, match="unexpected keyword argument 'colour'"):
        get_backend("ref").rasterization(**harmonics(), colour=1)


@pytest.mark.parametrize("packed", [False, True])
def test_meta_is_a_mapping_that_tells_the_truth(packed: bool) -> None:
    _, _, meta = rasterization(**scene(), **cameras(2), packed=packed)
    names = list(meta)
    assert set(names) >= GSPLAT_META | {"dominant_ids", "dominant_counts", "n_contrib", "n_traversed"}
    assert len(meta) == len(names)
    # as gsplat shapes them
    assert meta["tiles_per_gauss"].shape == meta["depths"].shape == ((len(meta["means2d"]),) if packed else (2, N))
    meta = rasterization(**scene(), **cameras(2), packed=packed)[2]
    assert "to be computed when read: ['dominant_ids'" in repr(meta)
    assert list(meta.keys()) == [key for key, _ in meta.items()] == list(dict(meta)) == list({**meta}) == names
    assert all(dict(meta)[key] is meta[key] for key in names)
    assert set(rasterization(**scene(), **cameras(2), packed=packed, dominance=True, counts=True)[2]) == set(names)
    with pytest.raises(KeyError, match="nothing"):
        meta["nothing"]
    assert meta.get("nothing") is None


def test_meta_computes_together_what_comes_together_and_only_once() -> None:
    meta, asked = RenderMeta({"a": 1}), []
    meta.defer(("b", "c"), lambda: (asked.append("bc"), {"b": 2, "c": 3})[1])
    meta.defer(("d",), lambda: (asked.append("d"), {"d": 4})[1])
    assert ("c" in meta, list(meta), len(meta)) == (True, ["a", "b", "c", "d"], 4)
    assert not asked
    meta["b"] = 20
    assert (meta["c"], meta["b"], asked) == (3, 20, ["bc"])
    assert dict(meta) == {"a": 1, "b": 20, "c": 3, "d": 4}
    assert asked == ["bc", "d"]
    doubled = meta.changed(lambda value: 2 * value)
    assert {**doubled} == {"a": 2, "b": 40, "c": 6, "d": 8}
    del meta["d"]
    assert list(meta) == ["a", "b", "c"]


def test_a_backend_that_cannot_run_says_why_in_one_sentence() -> None:
    cuda = get_backend("cuda")
    if cuda.available():
        pytest.skip("backend cuda runs here, so there is nothing to say")
    reason = cuda.why_not()
    with pytest.raises(PopError, match=re.escape(reason)):
        cuda.rasterization(**scene(), **cameras())


def test_an_unknown_backend_is_an_error_that_lists_the_known() -> None:
    with pytest.raises(PopError, match="fast"):
        get_backend("metal")
    with pytest.raises(PopError, match=f"backend 'metal' is unknown; use one of {', '.join(backend_names())}"):
        program(**scene(), **cameras(), backend="metal")
    with pytest.raises(PopError, match="backend is None; it must be a backend or the name of one"):
        program(**scene(), **cameras(), backend=None)


# The drop-in's arguments: gsplat 1.5.3's names and defaults, and what is refused, by name.


class RollingShutterType(Enum):
    """gsplat 1.5.3's enumeration of that name (`gsplat/cuda/_wrapper.py`), which a caller of gsplat passes."""

    ROLLING_TOP_TO_BOTTOM = 0
    ROLLING_LEFT_TO_RIGHT = 1
    ROLLING_BOTTOM_TO_TOP = 2
    ROLLING_RIGHT_TO_LEFT = 3
    GLOBAL = 4


# fmt: off
# names and defaults as `gsplat/rendering.py` of the wheel 1.5.3 spells them; `...` where there is none
GSPLAT_1_5_3: dict[str, Any] = {
    "means": ..., "quats": ..., "scales": ..., "opacities": ..., "colors": ..., "viewmats": ..., "Ks": ...,
    "width": ..., "height": ..., "near_plane": 0.01, "far_plane": 1e10, "radius_clip": 0.0, "eps2d": 0.3,
    "sh_degree": None, "packed": True, "tile_size": 16, "backgrounds": None, "render_mode": "RGB",
    "sparse_grad": False, "absgrad": False, "rasterize_mode": "classic", "channel_chunk": 32, "distributed": False,
    "camera_model": "pinhole", "segmented": False, "covars": None, "with_ut": False, "with_eval3d": False,
    "radial_coeffs": None, "tangential_coeffs": None, "thin_prism_coeffs": None, "ftheta_coeffs": None,
    "rolling_shutter": RollingShutterType.GLOBAL, "viewmats_rs": None,
}
# fmt: on


def test_the_signature_begins_with_gsplat_1_5_3s() -> None:
    parameters = inspect.signature(program).parameters
    assert list(parameters)[: len(GSPLAT_1_5_3)] == list(GSPLAT_1_5_3)
    assert all(p.kind is p.KEYWORD_ONLY for name, p in parameters.items() if name not in GSPLAT_1_5_3)
    for name, default in GSPLAT_1_5_3.items():
        ours = parameters[name].default
        # of the one default that is of a type of gsplat's, ours is None
        assert ours == (parameters[name].empty if default is ... else None if name == "rolling_shutter" else default)


@pytest.mark.parametrize("backend", ["fast", "compiled", "ref"])
def test_every_default_of_gsplat_1_5_3_is_accepted_where_it_is_passed(backend: str) -> None:
    skip_without(backend)
    defaults = {name: default for name, default in GSPLAT_1_5_3.items() if default is not ...}
    plain = program(**scene(), **cameras(), backend=backend)
    assert plain[0].std() > 0.0
    for given in (defaults, *({name: default} for name, default in defaults.items()), {"tile_size": None}):
        image, alphas, _ = program(**scene(), **cameras(), **given, backend=backend)
        assert torch.equal(image, plain[0])
        assert torch.equal(alphas, plain[1])


WRONG = {
    "means[3, 1] is nan": {
        "means": lambda t: t.index_put((torch.tensor(3), torch.tensor(1)), torch.tensor(np.nan).double())
    },
    "scales[2, 0] is -1.0": {
        "scales": lambda t: t.index_put((torch.tensor(2), torch.tensor(0)), torch.tensor(-1.0).double())
    },
    "quats[4] is [0.0, 0.0, 0.0, 0.0]": {"quats": lambda t: t.index_fill(0, torch.tensor([4]), 0.0)},
    "opacities[0] is 1.5": {"opacities": lambda t: t.index_fill(0, torch.tensor([0]), 1.5)},
    "quats has shape": {"quats": lambda t: t[:, :3]},
    "scales has dtype": {"scales": lambda t: t.float()},
    "Ks[0] is": {"Ks": lambda t: torch.zeros_like(t)},
    "viewmats[0] is": {"viewmats": lambda t: t * 2.0},
    "width is 0": {"width": lambda _: 0},
    "height is 0": {"height": lambda _: 0},
    "colors has shape": {"colors": lambda t: t[:-1]},
    "means is missing; it must be a torch.Tensor": {"means": lambda _: None},
    "opacities is missing": {"opacities": lambda _: None},
    "colors is missing": {"colors": lambda _: None},
    "quats is missing": {"quats": lambda _: None},
    "viewmats is missing": {"viewmats": lambda _: None},
    "Ks is of type ndarray; it must be a torch.Tensor": {"Ks": lambda t: t.numpy()},
    "width is None; it must be a whole number": {"width": lambda _: None},
    "height is 2.5; it must be a whole number": {"height": lambda _: 2.5},
    "width is True; it must be a whole number": {"width": lambda _: True},
    "tile_size is '16'; it must be a whole number": {"tile_size": lambda _: "16"},
    "viewmats has shape [0, 4, 4]; there must be at least one camera": {"viewmats": lambda t: t[:0]},
    "means has shape [0, 24, 3]; a batch must hold at least one scene": {"means": lambda t: t[None][:0]},
    "colors has shape [24]; it must be [24, D]": {"colors": lambda t: t[:, 0]},
    "quats is of type ndarray; it must be a torch.Tensor": {"quats": lambda t: t.numpy()},
    "backgrounds is of type list; it must be a torch.Tensor": {"backgrounds": lambda _: [0.0, 0.0, 0.0]},
    "sh_degree is 2.0; it must be None, 0, 1, 2 or 3": {"sh_degree": lambda _: 2.0},
    "near_plane is None; it must be a number": {"near_plane": lambda _: None},
    "far_plane is '9'; it must be a number": {"far_plane": lambda _: "9"},
    "eps2d is None; it must be a number": {"eps2d": lambda _: None},
    "radius_clip is None; it must be a number": {"radius_clip": lambda _: None},
}


@pytest.mark.parametrize("message", WRONG)
def test_wrong_input_is_named_with_its_index(message: str) -> None:
    given = {**scene(), **cameras()}
    (name, change), *_ = WRONG[message].items()
    with pytest.raises(ValueError, match=re.escape(message)):
        rasterization(**{**given, name: change(given.get(name))})


@pytest.mark.parametrize(
    "argument",
    [
        {"sparse_grad": True},
        {"distributed": True},
        {"camera_model": "fisheye"},
        {"segmented": True},
        {"with_ut": True},
        {"with_eval3d": True},
        {"radial_coeffs": torch.zeros(1, 6)},
        {"rolling_shutter": 1},
        {"rolling_shutter": RollingShutterType.ROLLING_LEFT_TO_RIGHT},
        {"viewmats_rs": torch.eye(4)[None]},
    ],
)
def test_unsupported_arguments_raise_by_name(argument: dict[str, object]) -> None:
    with pytest.raises(NotImplementedError, match=next(iter(argument))):
        rasterization(**scene(), **cameras(), **argument)


@pytest.mark.parametrize("backend", ["fast", "compiled", "ref"])
@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ({"near_plane": float("nan")}, "near_plane is nan; it must be a number"),
        ({"near_plane": -1.0}, "near_plane is -1.0; it must be finite and >= 0"),
        ({"near_plane": float("inf")}, "near_plane is inf; it must be finite and >= 0"),
        ({"far_plane": -1.0}, "far_plane is -1.0; it must be beyond near_plane, which is 0.01"),
        ({"far_plane": float("nan")}, "far_plane is nan; it must be a number"),
        ({"near_plane": 5.0, "far_plane": 4.0}, "far_plane is 4.0; it must be beyond near_plane, which is 5.0"),
        ({"eps2d": float("nan")}, "eps2d is nan; it must be a number"),
        ({"eps2d": -0.3}, "eps2d is -0.3; it must be finite and >= 0 px^2"),
        ({"radius_clip": float("nan")}, "radius_clip is nan; it must be >= 0 px"),
        ({"radius_clip": -1.0}, "radius_clip is -1.0; it must be >= 0 px"),
        ({"profile": 3}, "profile is 3; it must be a name or a pop_ref.constants.Profile"),
        ({"profile": replace(PAPER, alpha_floor=2.0)}, "alpha_floor is 2.0; it must be in (0, 1)"),
        ({"profile": replace(PAPER, alpha_ceiling=1.0)}, "alpha_ceiling is 1.0; it must be between alpha_floor and 1"),
    ],
)
def test_numbers_with_which_nothing_can_be_drawn_raise(backend: str, argument: dict[str, Any], said: str) -> None:
    skip_without(backend)
    expected = NotImplementedError if backend == "ref" and "radius_clip" in argument else ValueError
    match = "radius_clip=" if expected is NotImplementedError else re.escape(said)
    with pytest.raises(expected, match=match):
        program(**scene(), **cameras(), **argument, backend=backend)


class Passes(TorchDispatchMode):
    """Counts operations that read a tensor of at least so many numbers; what only names one anew reads nothing."""

    def __init__(self, least: int) -> None:
        super().__init__()
        self.least, self.found = least, list[str]()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given = [value for value in torch.utils._pytree.tree_leaves((args, kwargs)) if isinstance(value, torch.Tensor)]
        made = function(*args, **(kwargs or {}))
        seen = {value.untyped_storage().data_ptr() for value in given}
        anew = isinstance(made, torch.Tensor) and made.untyped_storage().data_ptr() in seen
        if not anew and max((value.numel() for value in given), default=0) >= self.least:
            self.found.append(str(function))
        return made


def test_values_are_asked_for_in_a_pass_or_two_a_tensor(monkeypatch: pytest.MonkeyPatch) -> None:
    # on a GPU every one is a launch, and they were three quarters of a plain rasterization's
    passes = Passes(least=200)
    values = Checks.values

    def counted(checks: Checks) -> None:
        with passes:
            values(checks)

    monkeypatch.setattr(Checks, "values", counted)
    g = torch.Generator().manual_seed(2)
    means = torch.randn(200, 3, generator=g) + torch.tensor([0.0, 0.0, 5.0])
    rows = (torch.randn(200, 4, generator=g), torch.full((200, 3), 0.1), torch.full((200,), 0.5))
    shot = cameras(dtype=torch.float32)
    program(means, *rows, torch.rand(200, 3, generator=g), **shot, backend="fast")
    assert 5 <= len(passes.found) <= 9, passes.found
