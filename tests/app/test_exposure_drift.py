"""Exposures told by the points that photographs share: measured, chosen by, and told before training."""

from __future__ import annotations

import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pop_fast.data import Capture, load_capture
from pop_fast.data.photo_quality import GAMMA, UNEVEN, Exposures, exposures, exposures_of, levels_at
from pop_fast.demo import make_demo
from pop_fast.train import TrainConfig
from pop_fast.train.automatic import choose_terms
from tests.app.captures import ring
from tests.app.conftest import Pop

_N_VIEWS, _N_POINTS = 30, 400


def test_a_level_is_stops_under_white_and_nothing_at_the_ends_of_the_scale() -> None:
    image = np.full((40, 60, 3), 128, np.uint8)
    image[:, 40:] = 255
    image[20:, :20] = 5
    places = np.array([[10.5, 5.5], [55.0, 5.0], [5.0, 35.0], [-0.1, 5.0], [60.0, 5.0], [np.nan, 5.0], [30.0, 39.9]])
    found = levels_at(image, places)
    gray = GAMMA * math.log2(128 / 255)
    np.testing.assert_allclose(found, [gray, np.nan, np.nan, np.nan, np.nan, np.nan, gray], atol=1e-5)
    # x is the column
    image = np.tile(np.linspace(60, 200, 60, dtype=np.uint8)[None, :, None], (40, 1, 3))
    left, right = levels_at(image, np.array([[12.0, 30.0], [48.0, 10.0]]))
    assert right > left + 1.0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_exposures_are_found_though_a_third_of_the_points_shine_or_are_hidden(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true, albedo = rng.normal(0.0, 0.3, _N_VIEWS), rng.normal(-2.0, 1.0, _N_POINTS)
    seen = [rng.permutation(_N_POINTS)[: rng.integers(60, 200)] for _ in range(_N_VIEWS)]
    levels = []
    for i, rows in enumerate(seen):
        values = true[i] + albedo[rows] + rng.normal(0.0, 0.05, len(rows))
        wrong = rng.random(len(rows)) < 1 / 3
        values[wrong] += rng.normal(0.0, 2.0, wrong.sum())
        values[rng.random(len(rows)) < 0.1] = np.nan
        levels.append(values)
    found = exposures(levels, seen)
    np.testing.assert_allclose(found.stops, true - np.median(true), atol=0.12)
    assert found.drift == pytest.approx(true.std(), abs=0.03)
    # the errors are about as large as they are said to be
    assert 0.3 < (found.stops - (true - np.median(true))).std() / found.errors.mean() < 2.0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_photographs_of_nothing_in_common_do_not_drift(seed: int) -> None:
    rng = np.random.default_rng(seed)
    seen = [np.arange(40)] * 30
    levels = [rng.normal(-2.0, 1.0, 40) for _ in seen]
    assert np.nanstd(exposures(levels, seen).stops) > 0.15
    assert (exposures(levels, seen).drift or 0.0) < 0.1


def test_what_changes_from_place_to_place_is_no_unevenness() -> None:
    viewmats = ring(_N_VIEWS)
    slow = np.sin(np.linspace(0.0, 2.0 * np.pi, _N_VIEWS, endpoint=False))
    order = np.random.default_rng(0).permutation(_N_VIEWS)
    for stops, low, high in ((slow, 0.0, 0.1), (slow[order], 0.6, 1.2), (np.zeros(_N_VIEWS), 0.0, 0.001)):
        found = Exposures(stops, np.full(_N_VIEWS, 0.01))
        assert found.drift == pytest.approx(stops.std(), abs=0.01)
        assert low <= (found.unevenness(viewmats) or 0.0) < high
    # photographs in another order are the same photographs
    assert Exposures(slow[order], np.zeros(_N_VIEWS)).unevenness(viewmats[order]) == pytest.approx(
        Exposures(slow, np.zeros(_N_VIEWS)).unevenness(viewmats)
    )
    assert Exposures(slow[:4], np.zeros(4)).unevenness(viewmats[:4]) is None


def test_a_photograph_that_shares_no_points_has_no_exposure() -> None:
    rows = [np.arange(50), np.arange(50), np.arange(100, 150), np.arange(10)]
    levels = [np.zeros(50), np.ones(50), np.ones(50), np.zeros(10)]
    found = exposures(levels, rows)
    assert np.isnan(found.stops).tolist() == [False, False, True, True]
    assert found.stops[1] - found.stops[0] == pytest.approx(1.0)
    assert found.drift == pytest.approx(0.5)
    assert exposures(levels[2:], rows[2:]).drift is None
    assert exposures([], []).drift is None


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("drift") / "demo"
    make_demo(made, views=24, width=120, height=90)
    return made


@pytest.fixture(scope="module")
def capture(folder: Path) -> Capture:
    return load_capture(folder)


def brighter(capture: Capture, stops: np.ndarray) -> Capture:
    """Let every photograph take so many stops more light."""
    views = []
    for view, stop in zip(capture.views, stops, strict=True):
        values = np.clip(view.image * 2.0 ** (stop / GAMMA), 0.0, 255.0)
        views.append(replace(view, image=values.round().astype(np.uint8)))
    return replace(capture, views=tuple(views))


@pytest.mark.parametrize(("width", "learned"), [(0.0, False), (0.4, True)])
def test_training_learns_exposures_where_the_points_say_that_they_differ(
    capture: Capture, width: float, learned: bool
) -> None:
    stops = np.random.default_rng(3).permutation(np.linspace(-1.0, 1.0, len(capture.views))) * width
    changed = brighter(capture, stops)
    found = exposures_of(changed)
    np.testing.assert_allclose(found.stops, stops - np.median(stops), atol=0.1)
    config = TrainConfig.of(preset="auto", backend="fast")
    terms = choose_terms(changed, config, None)
    assert terms.settings.get("exposure", False) is learned
    assert any("by their common points they differ by" in why for why in terms.why) is learned
    blind = replace(changed, views=tuple(replace(view, seen=None) for view in changed.views))
    assert exposures_of(blind).drift is None
    assert "exposure" not in choose_terms(blind, config, None).settings


def test_data_check_says_what_training_will_do(pop: Pop, folder: Path, tmp_path: Path) -> None:
    assert "exposure      the same points differ by 0.0" in pop.done("data", "check", folder).out
    shutil.copytree(folder, tmp_path / "demo")
    stops = np.random.default_rng(5).permutation(np.linspace(-0.8, 0.8, 24))
    paths = sorted((tmp_path / "demo" / "images").iterdir())
    for path, stop in zip(paths, stops, strict=True):
        image = np.clip(cv2.imread(str(path)) * 2.0 ** (stop / GAMMA), 0.0, 255.0)
        assert cv2.imwrite(str(path), image.round().astype(np.uint8))
    outcome = pop.done("data", "check", tmp_path / "demo")
    (line,) = [line for line in outcome.out.splitlines() if "the same points differ" in line]
    assert line.startswith("LOOK")
    told = float(line.partition("differ by ")[2].split()[0])
    assert told == pytest.approx(stops.std(), abs=0.1)
    assert float(line.partition("a photograph differs by ")[2].split()[0]) > UNEVEN
    darkest, brightest = paths[int(stops.argmin())].name, paths[int(stops.argmax())].name
    assert re.search(rf"photograph, -0\.\d+ \({darkest}\) to \+0\.\d+ \({brightest}\); a ", line)
    assert line.endswith("; lock the exposure, or train with --exposure")
