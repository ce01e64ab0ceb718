"""The compiled sums over pixels beside torch's: any tile size, long lists, clamped alphas, any number of threads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from pop_fast import compiled
from pop_fast.api.registry import get_backend
from pop_fast.density.passes import Passes
from pop_fast.stages.contributions import contributions
from pop_fast.stages.fisher import screen_moments
from pop_fast.stages.sensitivity import sensitivities
from pop_fast.stages.splatting import Splats
from pop_fast.stages.tiles import TileLists
from pop_ref.constants import PAPER, PROFILES, Profile
from tests.fast.pass_scenes import raw_params, views
from tests.fast.test_compiled import CEILINGS, HEIGHT, WIDTH
from tests.fast.test_compiled import Splats as Drawn
from tests.fast.test_compiled import splats as draw

pytestmark = pytest.mark.skipif(not compiled.available(), reason=compiled.why_not() or "")

BACKGROUND = torch.tensor([0.3, 0.1, 0.2], dtype=torch.float64)
PIXEL_MAP = torch.rand(HEIGHT, WIDTH, dtype=torch.float64, generator=torch.Generator().manual_seed(5))


def as_splats(drawn: Drawn) -> Splats:
    n, dtype = len(drawn.means2d), drawn.means2d.dtype
    radii = torch.ones((n, 2), dtype=torch.int32)
    return Splats(drawn.means2d, torch.zeros(n, dtype=dtype), drawn.conics, drawn.opacities, radii, None, drawn.colors)


def sums(functions: tuple[Callable, Callable, Callable], drawn: Drawn, profile: Profile) -> dict[str, Tensor]:
    """Take all sums of a view."""
    of_view = (as_splats(drawn), drawn.lists, WIDTH, HEIGHT, drawn.lists.tile_size)
    contributions, sensitivities, screen_moments = functions
    found = contributions(*of_view, PIXEL_MAP, profile)
    return {
        **{name: getattr(found, name) for name in ("weight_sum", "n_pixels", "map_sum", "distance_sum")},
        "sensitivities": sensitivities(*of_view, BACKGROUND, profile),
        "moments": screen_moments(*of_view, BACKGROUND, profile),
    }


def native() -> tuple[Callable, Callable, Callable]:
    stages = get_backend("compiled").stages()
    return stages.contributions, stages.sensitivities, stages.screen_moments


def assert_as_in_torch(drawn: Drawn, profile: Profile = PAPER) -> None:
    mine = sums(native(), drawn, profile)
    its = sums((contributions, sensitivities, screen_moments), drawn, profile)
    for name, expected in its.items():
        # a column of moments at a time: their units differ
        size = expected.double().abs().amax(0)
        assert float(size.min()) > 0.0, name
        assert float(((mine[name] - expected).abs() / size).max()) < 1e-12, name


@pytest.mark.parametrize("tile_size", [1, 4, 5, 8, 16, 64])
def test_any_tile_size_sums_as_in_torch(tile_size: int) -> None:
    assert_as_in_torch(draw(tile_size))


@pytest.mark.parametrize("profile", CEILINGS, ids=["paper", "low ceiling, no gradient", "low ceiling, passed through"])
def test_clamped_alphas_sum_as_in_torch(profile: Profile) -> None:
    assert_as_in_torch(draw(16), profile)


def test_lists_longer_than_a_chunk_sum_as_in_torch() -> None:
    drawn = draw(16, n=900)
    assert int(drawn.lists.lengths.max()) > 200
    assert_as_in_torch(replace(drawn, opacities=0.05 * drawn.opacities + 0.01))


def test_the_scores_of_a_tile_size_are_those_of_any_other() -> None:
    small, large = (sums(native(), draw(size), PAPER) for size in (4, 32))
    for name, expected in large.items():
        size = expected.double().abs().amax(0)
        assert float(((small[name] - expected).abs() / size).max()) < 1e-12, name


@pytest.mark.parametrize("profile", PROFILES)
def test_any_number_of_threads_gives_the_same_bits(profile: str) -> None:
    params, before = raw_params(400, torch.float32), torch.get_num_threads()
    pixel_map = torch.rand(22, 37, generator=torch.Generator().manual_seed(9))

    def found(threads: int) -> list[Tensor]:
        torch.set_num_threads(threads)
        try:
            made = Passes("compiled", views(torch.float32), profile, (0.1, 0.2, 0.3))
            all_sums = made.contributions(params, 0, 3, pixel_map)
            names = ("weight_sum", "n_pixels", "map_sum", "distance_sum", "dominant_counts", "image")
            rest = [made.sensitivities(params, 0, 3), made._open(made._shot(params, 0, 3))._moments()]
            return [*(getattr(all_sums, name) for name in names), *rest, *made.dominant_points(params, 0, 3)]
        finally:
            torch.set_num_threads(before)

    one = found(1)
    for threads in (2, 3, 5):
        assert all(torch.equal(a, b) for a, b in zip(one, found(threads), strict=True))


def test_an_empty_view_sums_to_nothing() -> None:
    drawn = draw(16)
    nothing = TileLists(drawn.lists.ids[:0], torch.zeros_like(drawn.lists.offsets), 16, 3, 3)
    for name, total in sums(native(), replace(drawn, lists=nothing), PAPER).items():
        assert not bool(total.any()), name


def test_lists_of_another_grid_are_refused() -> None:
    drawn = draw(16)
    for stage in native():
        with pytest.raises(ValueError, match="45 x 38 px in tiles of 8 px are 6 x 5"):
            stage(as_splats(drawn), drawn.lists, WIDTH, HEIGHT, 8)


def test_moments_take_three_channels() -> None:
    drawn = draw(16, channels=2)
    with pytest.raises(ValueError, match="2 colour channels"):
        native()[2](as_splats(drawn), drawn.lists, WIDTH, HEIGHT, 16)


@pytest.mark.parametrize("channels", [1, 2, 5])
def test_sensitivities_take_any_number_of_channels(channels: int) -> None:
    drawn = draw(16, channels=channels)
    background = torch.linspace(0.1, 0.5, channels, dtype=torch.float64)
    of_view = (as_splats(drawn), drawn.lists, WIDTH, HEIGHT, 16, background)
    torch.testing.assert_close(native()[1](*of_view), sensitivities(*of_view), rtol=1e-12, atol=1e-14)
    with pytest.raises(ValueError, match="background has shape"):
        native()[1](*of_view[:-1], torch.zeros(channels + 1, dtype=torch.float64))
