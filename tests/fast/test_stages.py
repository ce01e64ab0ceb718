"""What the laws leave open of the fast stages: losses in bands, threads and float32, tile lists, refusals."""

from __future__ import annotations

import itertools
import re
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import cuda_ext
from pop_fast import compiled
from pop_fast.compiled import losses as compiled_losses
from pop_fast.density import rows as ops
from pop_fast.stages import density as fast
from pop_fast.stages import losses, tiles
from pop_fast.stages.regularizers import importance_mask, opacity_entropy, pop_loss
from pop_fast.stages.tiles import TileLists, tight_tile_lists, tile_lists
from pop_ref import losses as oracle_losses
from pop_ref import ssim as oracle_ssim
from pop_ref.constants import INRIA, PAPER, SPEEDY_SPLAT, Profile
from pop_ref.magnitudes import d_ssim_magnitudes, pixelwise_magnitudes
from pop_ref.tight_tiles import tight_tile_lists as oracle_lists
from tests.fast.test_compiled import HEIGHT, WIDTH, assert_alike
from tests.fast.test_compiled import splats as draw

NAMES = ("l1", "l2", "ssim", "d_ssim", "photometric_3dgs", "photometric_pop")
COMPILED = pytest.mark.skipif(not compiled.available(), reason=compiled.why_not() or "")


class Case(NamedTuple):
    """A pair of images to compare; small when printed."""

    height: int = 12
    width: int = 12
    channels: int = 3
    kind: str = "noisy"
    seed: int = 0
    masked: bool = False
    padding: str = "valid"

    def images(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a render and a photograph whose values float32 holds exactly."""
        rng = np.random.default_rng(self.seed)
        y = rng.random((self.height, self.width, self.channels))
        if self.kind == "flat":
            y = np.full_like(y, 0.75)
        if self.kind == "black and white":
            y = np.round(y)
        noise = {"close": 1e-3, "equal": 0.0}.get(self.kind, 0.25)
        x = rng.random(y.shape) if self.kind == "unrelated" else y + noise * rng.normal(size=y.shape)
        return x.astype(np.float32).astype(np.float64), y.astype(np.float32).astype(np.float64)

    def tensors(self, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
        x, y = self.images()
        return torch.tensor(x, dtype=dtype), torch.tensor(y, dtype=dtype)

    def mask(self) -> np.ndarray | None:
        return np.random.default_rng(self.seed).random((self.height, self.width)) < 0.75 if self.masked else None

    def options(self, name: str) -> dict[str, str]:
        return {} if name in ("l1", "l2") else {"padding": self.padding}


def cases() -> st.SearchStrategy[Case]:
    common = {
        "channels": st.sampled_from([3, 1, 4]),
        "kind": st.sampled_from(["noisy", "close", "equal", "flat", "black and white", "unrelated"]),
        "seed": st.integers(0, 2**16),
        "masked": st.booleans(),
    }
    whole, any_size = st.integers(11, 24), st.integers(1, 24)
    inside = st.builds(Case, whole, whole, **common, padding=st.just("valid"))
    return inside | st.builds(Case, any_size, any_size, **common, padding=st.just("same"))


def both(
    name: str, case: Case, dtype: torch.dtype, module: ModuleType = losses
) -> tuple[float, np.ndarray, float, np.ndarray]:
    """Return value and gradient of the oracle_losses, then of the fast loss."""
    options, (x, y), mask = case.options(name), case.images(), case.mask()
    value = getattr(oracle_losses, name)(x, y, mask=mask, **options)
    v_image = getattr(oracle_losses, name + "_vjp")(x, y, 1.0, mask=mask, **options)
    image = torch.tensor(x, dtype=dtype, requires_grad=True)
    kept = None if mask is None else torch.tensor(mask)
    loss = getattr(module, name)(image, torch.tensor(y, dtype=dtype), mask=kept, **options)
    loss.backward()
    assert loss.dtype == image.grad.dtype == dtype
    return value, v_image, loss.item(), image.grad.numpy()


@COMPILED
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_compiled_bits_do_not_depend_on_the_number_of_threads(dtype: torch.dtype, masked: bool) -> None:
    case = Case(90, 47, masked=masked)
    (x, y), mask = case.tensors(dtype), case.mask()
    kept = None if mask is None else torch.tensor(mask)

    def found() -> list[torch.Tensor]:
        image = x.clone().requires_grad_()
        loss = compiled_losses.d_ssim(image, y, mask=kept)
        loss.backward()
        assert loss.item() > 0.01
        return [loss.detach(), image.grad]

    assert_alike(found, (2, 5))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_loss_does_not_depend_on_the_number_of_threads(dtype: torch.dtype) -> None:
    # so many values that torch shares them out
    x, y = Case(240, 320, seed=9).tensors(dtype)
    assert_alike(lambda: [losses.photometric_3dgs(x, y, padding="same"), losses.l2(x, y)], (2, 3, 4, 5))


@pytest.mark.parametrize("padding", ["valid", "same"])
def test_similarity_maps_are_the_oracles(padding: str, monkeypatch: pytest.MonkeyPatch) -> None:
    x, y = Case(20, 14, seed=3).images()
    monkeypatch.setattr(losses, "_BAND_VALUES", 1)
    ours = losses.ssim_map(torch.tensor(x), torch.tensor(y), padding)
    np.testing.assert_allclose(ours.numpy(), oracle_ssim.ssim_map(x, y, padding), atol=1e-12)


@pytest.mark.parametrize("padding", ["valid", "same"])
def test_bands_change_no_bit_of_the_gradient(padding: str, monkeypatch: pytest.MonkeyPatch) -> None:
    x, y = Case(60, 17, seed=4).tensors()
    whole = losses.photometric_pop_vjp(x, y, 1.0, padding=padding)
    for band in (1, 17 * 3 * 13, 17 * 3 * 25):
        monkeypatch.setattr(losses, "_BAND_VALUES", band)
        assert torch.equal(losses.photometric_pop_vjp(x, y, 1.0, padding=padding), whole)


@pytest.mark.parametrize("padding", ["valid", "same"])
def test_kept_moments_change_no_bit(padding: str) -> None:
    x, y = Case(21, 17, seed=5).tensors()
    moments = losses.target_moments(y, padding)
    for _ in range(2):
        assert torch.equal(losses.ssim(x, y, padding, moments=moments), losses.ssim(x, y, padding))
        assert torch.equal(losses.ssim_vjp(x, y, 1.0, padding, moments=moments), losses.ssim_vjp(x, y, 1.0, padding))


def test_two_runs_give_the_same_bits_and_leave_their_arguments_alone() -> None:
    x, y = Case(40, 30, seed=6).tensors()
    copies = x.clone(), y.clone()
    first, second = (losses.photometric_3dgs_vjp(x, y, 1.0) for _ in range(2))
    assert torch.equal(first, second)
    assert torch.equal(x, copies[0])
    assert torch.equal(y, copies[1])


def test_pixels_that_are_left_out_may_be_anything() -> None:
    x, y = Case(14, 15, seed=8).tensors(torch.float64)
    mask = torch.rand(14, 15, generator=torch.Generator().manual_seed(0)) < 0.5
    poisoned = torch.where(mask[:, :, None], x, torch.nan)
    for name in NAMES:
        loss, vjp = getattr(losses, name), getattr(losses, name + "_vjp")
        assert torch.equal(loss(poisoned, y, mask=mask), loss(x, y, mask=mask))
        v_image = vjp(poisoned, y, 1.0, mask=mask)
        assert torch.all(v_image[~mask] == 0.0)
        assert torch.equal(v_image, vjp(x, y, 1.0, mask=mask))


def test_a_strided_view_of_a_render_is_taken_as_it_is() -> None:
    x, y = Case(12, 13, 4, seed=10).tensors(torch.float64)
    render = x.clone().requires_grad_()
    losses.photometric_pop(render[:, :, :3], y[:, :, :3]).backward()
    expected = losses.photometric_pop_vjp(x[:, :, :3].contiguous(), y[:, :, :3].contiguous(), 1.0)
    torch.testing.assert_close(render.grad[:, :, :3], expected, rtol=1e-14, atol=0.0)
    assert not torch.any(render.grad[:, :, 3])


def test_without_gradients_no_graph_is_made() -> None:
    x, y = Case(12, 12, seed=11).tensors(torch.float64)
    assert not losses.photometric_pop(x, y).requires_grad
    with torch.no_grad():
        assert not losses.photometric_pop(x.clone().requires_grad_(), y).requires_grad


def test_unfit_arguments_are_refused_with_the_fix() -> None:
    x = torch.zeros(12, 12, 3)
    small = torch.zeros(10, 12, 3)
    for call, message in (
        (lambda: losses.l2(x, x[:, :11]), r"image is \[12, 12, 3\] but target is \[12, 11, 3\]"),
        (lambda: losses.l1(x[0], x[0]), r"must be \[H, W, D\]"),
        (lambda: losses.ssim(small, small), "use padding='same' or a larger image"),
        (lambda: losses.ssim(x, x, "reflect"), "padding is 'reflect'"),
        (lambda: losses.l2(x, x.clone().requires_grad_()), r"pass target.detach\(\)"),
        (lambda: losses.l2(x, x, torch.ones(12, 11, dtype=torch.bool)), "mask is"),
        (lambda: losses.l2(x, x, torch.ones(12, 12)), "it must be bool"),
        (lambda: losses.ssim(x, x, moments=losses.target_moments(x, "same")), "moments are of another"),
        (lambda: losses.ssim(x, x, moments=losses.target_moments(x.double())), "moments are of another"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


# The fast losses are the oracle's to rounding, pixel by pixel, where the laws allow more.

PADDED = NAMES[2:]
EVERYWHERE = [
    *(pytest.param(losses, name, id=name) for name in NAMES),
    *(pytest.param(compiled_losses, name, id=f"compiled {name}", marks=COMPILED) for name in PADDED),
]
# units of rounding that value and gradient of a term may need: twice the worst that 3,000 random cases of the strategy
# below did, of torch and of the compiled stage alike; one unit is what `magnitudes` bounds
UNITS = {"l1": (2.5, 2.0), "l2": (2.5, 2.5), "d_ssim": (1.0, 0.5)}
# what an objective is mixed of
TERMS = {
    "l1": (("l1", 1.0),),
    "l2": (("l2", 1.0),),
    "ssim": (("d_ssim", 1.0),),
    "d_ssim": (("d_ssim", 1.0),),
    "photometric_3dgs": (("l1", 0.8), ("d_ssim", 0.2)),
    "photometric_pop": (("l2", 0.99), ("d_ssim", 0.01)),
}


def allowed(name: str, case: Case) -> tuple[float, np.ndarray]:
    """Return what rounding may do to a loss in float32, and to the oracle's, and pixel by pixel to its gradient."""
    # SSIM itself is rounded where it is a difference from 1
    value, gradient = (2.0**-23 if name == "ssim" else 0.0), np.zeros((case.height, case.width, case.channels))
    (x, y), mask = case.images(), case.mask()
    for term, weight in TERMS[name]:
        for form, eps in (("difference", 2.0**-23), ("textbook", 2.0**-52)):
            if term == "d_ssim":
                found = d_ssim_magnitudes(x, y, case.padding, mask, form)
            else:
                found = pixelwise_magnitudes(x, y, 1 if term == "l1" else 2, mask)
            value += weight * UNITS[term][0] * eps * found.value
            gradient += weight * UNITS[term][1] * eps * found.gradient
    return value, gradient


@pytest.mark.parametrize(("module", "name"), EVERYWHERE)
@given(case=cases())
def test_loss_and_gradient_are_the_oracles_to_rounding_in_float32(module: ModuleType, name: str, case: Case) -> None:
    value, v_image, loss, grad = both(name, case, torch.float32, module)
    of_value, of_gradient = allowed(name, case)
    assert abs(loss - value) <= of_value + 1e-300
    assert np.all(np.abs(grad - v_image) <= of_gradient)


@pytest.mark.parametrize("name", PADDED)
@pytest.mark.parametrize(("kind", "most"), [("noisy", 1e-5), ("close", 2e-6), ("unrelated", 5e-5), ("flat", 2e-3)])
def test_what_rounding_may_do_in_float32_is_small_beside_the_gradient(name: str, kind: str, most: float) -> None:
    case = Case(kind=kind, height=16, width=14, seed=3)
    gradient = both(name, case, torch.float64)[1]
    assert np.max(allowed(name, case)[1]) < most * np.max(np.abs(gradient))


# The fast POP loss through autograd; the laws judge its value and its transpose.


def test_nothing_flows_through_the_mask_and_no_graph_is_made_without_need() -> None:
    o = torch.tensor([0.25, 0.5])
    assert not pop_loss(o, torch.tensor([True, False])).requires_grad
    with torch.no_grad():
        assert not pop_loss(o.clone().requires_grad_(), torch.tensor([True, False])).requires_grad


def test_counts_are_no_mask() -> None:
    counts = torch.tensor([2, 0, 0])
    with pytest.raises(ValueError, match=r"mask is torch.int64 \[3\]; it must be torch.bool \[3\], as importance_mask"):
        pop_loss(torch.tensor([0.5, 0.25, 0.25]), counts)
    with pytest.raises(ValueError, match=r"mask is torch.bool \[3\]; it must be torch.bool \[2\]"):
        pop_loss(torch.tensor([0.5, 0.25]), importance_mask(counts))


def test_second_derivatives_are_right_or_refused() -> None:
    x = torch.linspace(-2.0, 3.0, 7, dtype=torch.float64, requires_grad=True)
    for term in (opacity_entropy, lambda logits: pop_loss(logits.sigmoid(), torch.arange(7) < 3)):
        assert torch.autograd.gradgradcheck(term, x)
        assert bool((torch.autograd.functional.hessian(term, x).diagonal() != 0.0).any())
    image = torch.rand((12, 11, 3), dtype=torch.float64)
    for module in (losses, compiled_losses) if compiled.why_not() is None else (losses,):
        with pytest.raises(RuntimeError, match="no second derivatives"):
            torch.autograd.functional.hessian(partial(module.photometric_pop, target=image), image)


def test_masks_of_several_views_are_made_at_once() -> None:
    assert importance_mask(torch.tensor([[0, 2], [1, 0]])).tolist() == [[False, True], [True, False]]


def test_draws_for_another_number_of_parents_are_refused() -> None:
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3)}
    params = {key: torch.nn.Parameter(torch.ones((3, *shape))) for key, shape in shapes.items()}
    with pytest.raises(ValueError, match=r"normals is \[2, 3, 3\]; it must be \[2, 1, 3\]"):
        ops.split(params, {}, {}, torch.tensor([True, False, False]), torch.zeros(2, 3, 3))


def test_blur_set_takes_several_views_at_once() -> None:
    counts = torch.tensor([[1, 2], [3, 0]])
    assert fast.blur_set(counts, 8, 4, 1 / 32).tolist() == [[False, True], [True, False]]


# Exact tile lists of many splats at once: the oracle's, and no shorter than what can be blended.

PROFILES = [PAPER, INRIA, SPEEDY_SPLAT]


def by_tile(lists: TileLists) -> list[list[int]]:
    return [lists.ids[a:b].tolist() for a, b in itertools.pairwise(lists.offsets.tolist())]


def arguments(tile_size: int):
    drawn = draw(tile_size, n=300)
    generator = torch.Generator().manual_seed(4)
    radii = torch.randint(0, 24, (300, 2), generator=generator, dtype=torch.int32)
    depths = 1.0 + torch.rand(300, generator=generator, dtype=torch.float64)
    return drawn.means2d, drawn.conics, drawn.opacities, radii, depths, WIDTH, HEIGHT, tile_size


@pytest.mark.parametrize("tile_size", [4, 16])
@pytest.mark.parametrize("profile", PROFILES, ids=lambda profile: profile.name)
def test_tight_lists_are_the_oracles(profile: Profile, tile_size: int) -> None:
    given = arguments(tile_size)
    arrays = [t.numpy() for t in given[:5]]
    arrays[3] = arrays[3].astype("int64")
    expected = oracle_lists(*arrays, *given[5:], profile)
    assert sum(map(len, expected)) > 400
    assert by_tile(tight_tile_lists(*given, profile)) == expected


@pytest.mark.parametrize("profile", PROFILES, ids=lambda profile: profile.name)
def test_a_tile_whose_pixel_centres_are_met_is_met(profile: Profile) -> None:
    means2d, conics, opacities, radii, depths, *grid = arguments(4)
    tight = by_tile(tight_tile_lists(means2d, conics, opacities, radii, depths, *grid, profile))
    exact = by_tile(tile_lists(means2d, radii, depths, *grid, profile, conics=conics, opacities=opacities))
    whole = by_tile(tile_lists(means2d, radii, depths, *grid, profile))
    for few, some, many in zip(exact, tight, whole, strict=True):
        # at the rim of a tile a pixel centre is half a pixel inside, which is more than the slack of `tile_lists`
        assert [i for i in some if i in few] == few
        assert [i for i in many if i in some] == some
    assert sum(map(len, exact)) < sum(map(len, tight)) < sum(map(len, whole))


# Tile lists are sorted stably, whatever the number of entries makes of the way they are sorted.


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
    assert tuple(map(float, found.groups())) == (tiles.SLACK, tiles.SLACK_SHARE)
    # nowhere else is there another
    sources = [header, *Path(tiles.__file__).parent.rglob("*.py"), *Path(compiled.__file__).parent.glob("*.h")]
    slacks = [path.name for path in sources if re.search(r"\bslack\b.*=", path.read_text())]
    assert sorted(slacks) == ["lists.h", "tiles.cuh", "tiles.py"]
