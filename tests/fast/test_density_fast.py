"""What the laws of density control leave open: types, several views at once, thresholds hit exactly, refusals."""

from __future__ import annotations

import itertools
import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import cuda_ext
from pop_fast import compiled
from pop_fast.density import rows as ops
from pop_fast.stages import density as fast
from pop_fast.stages import tiles
from pop_fast.stages.blend import Stop, count_passed, weights_of_alphas
from pop_fast.stages.tiles import TileLists, tight_tile_lists, tile_lists
from pop_fast.train.model import make_optimizers
from pop_ref import density as oracle
from pop_ref.conformance.backends import shipped
from pop_ref.constants import INRIA, PAPER, SPEEDY_SPLAT, Profile
from pop_ref.pixel import stops
from pop_ref.tight_tiles import tight_tile_lists as oracle_lists
from tests.fast.test_compiled import HEIGHT, WIDTH
from tests.fast.test_compiled import splats as draw

CONFIGS = st.builds(
    oracle.DensityConfig,
    inclusive=st.booleans(),
    grad_denominator=st.sampled_from(["visible_views", "window"]),
    grow_on_gradient=st.booleans(),
    grow_on_gradient_in_blur_window=st.booleans(),
    prune_too_big=st.booleans(),
    # dyadic thresholds, which the values below hit exactly
    grow_grad2d=st.sampled_from([0.5, 1.0]),
    grow_scale3d=st.just(0.25),
    prune_scale3d=st.just(0.5),
    prune_opa=st.just(0.125),
    theta_blur=st.sampled_from([0.25, 0.5]),
    blur_min_pixels=st.sampled_from([0.0, 5.0]),
    blur_window=st.sampled_from(["any_view", "sum", "own_view"]),
    blur_rule=st.sampled_from(["by_scale", "split"]),
)
STEPS = st.sampled_from([600, 3000, 5000, 7000, 7100])
KEYS = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3)}


@pytest.mark.parametrize("backend", ["fast64", "fast32"])
@given(
    n=st.integers(0, 8), seed=st.integers(0, 999), config=CONFIGS, step=STEPS, scene_scale=st.sampled_from([1.0, 4.0])
)
def test_statistics_and_masks_are_the_oracles_exactly_also_at_thresholds(
    n: int, seed: int, config: oracle.DensityConfig, step: int, scene_scale: float, backend: str
) -> None:
    judged = shipped(backend).stage
    rng = np.random.default_rng(seed)
    ours = theirs = oracle.zero_statistics(n)
    for width, height in ((4, 4), (8, 4), (4, 2)):
        v_means2d = rng.choice([0.0, 0.125, 0.25], (n, 1)) * np.array([0.5, 0.0] if width == 8 else [0.0, 1.0])
        kept = int(rng.integers(1, width * height)) if width == 8 else None
        view = (v_means2d, rng.random(n) < 0.75, rng.integers(0, 10, n), width, height, config, kept)
        theirs = oracle.accumulate(theirs, *view)
        found = judged("accumulate")(ours, *view)
        ours = oracle.Statistics(**{f.name: getattr(found, f.name) for f in fields(theirs)})
    for name in ("grad_sum", "n_visible", "n_views", "blurred"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    scales = scene_scale * rng.choice([0.125, 0.25, 0.5, 0.75], (n, 3))
    opacities = rng.choice([0.0625, 0.125, 0.5], n)
    for name, given_rows in (("grow_masks", (theirs, scales)), ("prune_mask", (opacities, scales))):
        rest = (scene_scale, step, config)
        np.testing.assert_array_equal(judged(name)(*given_rows, *rest), getattr(oracle, name)(*given_rows, *rest))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_every_edit_keeps_the_type_the_counter_and_the_rate(dtype: torch.dtype) -> None:
    mask = torch.tensor([True, False, True, False, False, True])
    normals = torch.ones((2, 3, 3), dtype=dtype)
    for edit, args in ((ops.clone, (mask,)), (ops.split, (mask, normals)), (ops.prune, (mask,))):
        params = {key: torch.nn.Parameter(torch.ones((6, *shape), dtype=dtype)) for key, shape in KEYS.items()}
        optimizers = make_optimizers(params)
        for key, optimizer in optimizers.items():
            optimizer.param_groups[0]["lr"] = 0.25
            params[key].grad = torch.ones_like(params[key])
            optimizer.step()
        edit(params, optimizers, {}, *args)
        for key, optimizer in optimizers.items():
            assert params[key].dtype == dtype
            state = optimizer.state[params[key]]
            assert state["step"] == 1.0
            assert state["exp_avg"].shape == state["exp_avg_sq"].shape == params[key].shape
            assert state["exp_avg"].dtype == dtype
            assert optimizer.param_groups[0]["lr"] == 0.25


def test_draws_for_another_number_of_parents_are_refused() -> None:
    params = {key: torch.nn.Parameter(torch.ones((3, *shape))) for key, shape in KEYS.items()}
    with pytest.raises(ValueError, match=r"normals is \[2, 3, 3\]; it must be \[2, 1, 3\]"):
        ops.split(params, {}, {}, torch.tensor([True, False, False]), torch.zeros(2, 3, 3))


@given(st.floats(-30.0, 30.0))
def test_revised_opacity_is_the_oracles_also_next_to_zero_and_one(logit: float) -> None:
    rows = oracle.rows_from_params(
        {key: np.full((1, *shape), logit if key == "opacities" else 1.0) for key, shape in KEYS.items()}
    )
    split = (rows, np.array([True]), np.ones((2, 1, 3)), True)
    got = shipped("fast64").stage("split_rows")(*split).params["opacities"]
    np.testing.assert_allclose(got, oracle.split_rows(*split).params["opacities"], rtol=1e-13)


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
    assert found is not None
    assert tuple(map(float, found.groups())) == (tiles.SLACK, tiles.SLACK_SHARE)
    # nowhere else is there another
    sources = [header, *Path(tiles.__file__).parent.rglob("*.py"), *Path(compiled.__file__).parent.glob("*.h")]
    slacks = [path.name for path in sources if re.search(r"\bslack\b.*=", path.read_text())]
    assert sorted(slacks) == ["lists.h", "tiles.cuh", "tiles.py"]


# A step of the blend, pixel by pixel: weights, the light that is left and the entries passed are the oracle's.

TILES, K, PIXELS = 7, 8, 9


def alphas(share: float) -> torch.Tensor:
    """Return alphas between 0 and `share`, a fifth of them 0."""
    generator = torch.Generator().manual_seed(3)
    alpha = torch.rand(TILES, K, PIXELS, generator=generator, dtype=torch.float64)
    return torch.where(alpha < 0.2, 0.0, share * alpha)


@pytest.mark.parametrize("profile", [PAPER, INRIA], ids=lambda p: p.name)
@pytest.mark.parametrize("share", [1.0, 0.3], ids=["many pixels stop", "one pixel stops"])
def test_weights_light_and_passed_entries_are_the_oracles(profile, share):
    alpha = alphas(share)
    alpha[2, :, 4] = 0.95
    lights = torch.full((TILES, K + 1, PIXELS), 7.0, dtype=torch.float64)
    lights[:, 0] = torch.linspace(0.0, 1.0, PIXELS)
    light, masked, stop = lights[:, 0].clone(), alpha.clone(), Stop.of(profile, alpha.dtype)
    passed = count_passed(alpha, light, stop)
    weight = weights_of_alphas(masked, lights, stop)
    rests = torch.threshold(lights[:, -1], stop.at, 0.0)
    stopped = 0
    for tile in range(TILES):
        for pixel in range(PIXELS):
            T, expected, went_past = float(light[tile, pixel]), [0.0] * K, 0
            for k in range(K):
                rest = T * (1.0 - float(alpha[tile, k, pixel]))
                if stops(rest, profile):
                    T = 0.0
                    break
                expected[k], T, went_past = T * float(alpha[tile, k, pixel]), rest, went_past + 1
            stopped += went_past < K
            assert weight[tile, :, pixel].tolist() == pytest.approx(expected, abs=1e-15)
            assert float(rests[tile, pixel]) == pytest.approx(T, abs=1e-15)
            assert int(passed[tile, pixel]) == went_past
            assert masked[tile, :went_past, pixel].tolist() == alpha[tile, :went_past, pixel].tolist()
            assert not masked[tile, went_past:, pixel].any()
    # the first pixel of each tile is dark from the beginning
    assert stopped > 20 if share == 1.0 else stopped == TILES + 1
