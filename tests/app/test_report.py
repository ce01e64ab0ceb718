"""report.html: what it shows, what it is made from, and that it needs nothing but itself."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pop_fast.data import load_capture
from pop_fast.data.capture import View, neighbour_degrees
from pop_fast.density.passes import Passes, ViewContributions
from pop_fast.errors import PopError
from pop_fast.io import images
from pop_fast.io.images import colormap_table, depth_picture, depth_range
from pop_fast.io.ply import Frame, save_ply
from pop_fast.train.config import TrainConfig
from pop_fast.train.engines import renderer
from pop_fast.train.load_result import load_splat
from pop_fast.train.views import ViewTensors
from pop_fast.view.document import Chart, Series, Window, draw, draw_histogram, nice_ticks, short_number
from pop_fast.view.paths import frames_in
from pop_fast.view.report import checks, write_report
from pop_fast.view.report.checks import (
    Checks,
    are_floaters,
    are_veils,
    misfit_share,
    near_limit,
    nearer_than,
    patch_share,
    read_checks,
    stops_between,
    write_checks,
)
from pop_fast.view.report.model import verdict
from pop_fast.view.report.source import read_result, running_mean, thin_out
from tests.app.conftest import TRAIN, TRAIN_AND_CHECK, Pop
from tests.app.damage import says
from tests.app.test_render import around
from tests.app.tiny import tiny_capture
from tests.browser import browser


class Tags(HTMLParser):
    """Collects tags, and checks that they nest."""

    VOID = frozenset({"meta", "img", "br", "input"})

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[tuple[str, dict[str, str | None]]] = []
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def html(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_report(write_result(tmp_path_factory.mktemp("result") / "toy")).read_text(encoding="utf-8")


def text_of(page: str) -> str:
    return unescape(re.sub(r"<[^>]+>", " ", page))


def test_the_page_is_well_formed_and_loads_nothing_from_elsewhere(html: str) -> None:
    tags = Tags(html).seen
    sources = [value for _, attrs in tags for key, value in attrs.items() if key in ("src", "href") and value]
    assert sources
    links = {"cfg.json", "metrics.jsonl"}
    assert all(source.startswith("data:image/") for source in set(sources) - links)
    assert links < set(sources)
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", html)
    assert "@import" not in html


def test_numbers_windows_densification_steps_and_settings_are_those_of_the_run(html: str) -> None:
    for words in (
        *("24.50", "0.8100", "1,200", "1,100 with opacity", "no weights were given", "10.0 iterations"),
        *(f"{1200 * 236 / 2**20:.1f}", f"as PLY {1200 * 248 / 2**20:.1f}"),
        *("density control 5–150", "blur densification 30–70", "POP loss 0–150", "opacity reset at 40"),
        *("Densification steps (2)", "pop.theta_blur"),
    ):
        assert words in text_of(html), words


def test_every_curve_is_drawn_with_its_data_under_the_pointer(html: str) -> None:
    charts = [json.loads(str(attrs["data-chart"])) for _, attrs in Tags(html).seen if "data-chart" in attrs]
    names = [[series["n"] for series in chart["series"]] for chart in charts]
    assert names == [
        ["N"],
        ["training view, running mean", "held-out views"],
        ["running mean"],
        ["traversed", "blended"],
    ]
    assert charts[0]["series"][0]["y"][:3] == [1000, 1010, 1020]
    assert charts[1]["series"][1] == {"n": "held-out views", "c": "var(--c2)", "x": [300], "y": [24.5]}


def test_histograms_stand_for_start_middle_and_end_and_plain_density_control_has_one_window(tmp_path: Path) -> None:
    histograms = read_result(write_result(tmp_path / "r")).histograms
    assert [h.title for h in histograms] == ["start", "iteration 70", "end"]
    assert histograms[0].share_between(0.1, 0.2) == 1.0
    assert sum(histograms[2].shares) == pytest.approx(1.0)
    names = [window.name for window in read_result(write_result(tmp_path / "g", method="gsplat")).windows]
    assert names == ["density control"]


def test_every_held_out_view_is_shown_as_render_photo_and_error(html: str) -> None:
    alts = [attrs["alt"] for tag, attrs in Tags(html).seen if tag == "img"]
    assert {f"{what} of {name}" for name in VIEWS for what in ("render", "photo", "error")} <= set(alts)
    assert f"dominant Gaussians of {VIEWS[0]}" in alts
    # 24 dB before 25, and no pictures of depth where there are none
    assert alts.index(f"photo of {VIEWS[0]}") < alts.index(f"photo of {VIEWS[1]}")
    assert "depth of" not in html


@pytest.mark.parametrize(("views", "said"), [(0, None), (1, "1 held-out view"), (4, "4 held-out views")])
def test_nothing_is_said_of_held_out_views_where_there_are_none(tmp_path: Path, views: int, said: str | None) -> None:
    psnr = [30.0, 29.5] if views else [None, None]
    entries = [
        {"format": name, "bytes": 24_800 // (k + 1), "num_gaussians": 100, "psnr": psnr[k], "views": views}
        for k, name in enumerate(("ply", "spz"))
    ]
    found = read_result(write_result(tmp_path / "r", views=views, psnr=psnr[0], encodings=entries))
    heads, whole, small = found.files
    assert heads[:4] == ("format", "MB", "B/Gaussian", "of the PLY")
    assert heads[4:] == (() if said is None else (f"PSNR of {said}",))
    assert whole == ("ply", "0.02", "248.0", "1/1.0", *(() if said is None else ("30.00 dB",)))
    assert small == ("spz", "0.01", "124.0", "1/2.0", *(() if said is None else ("29.50 dB (-0.50)",)))
    assert ("held-out" in found.subtitle) == (said is not None)
    assert said is None or found.subtitle.split(" · ")[2] == said


def test_the_report_reads_only_the_result_folder_and_that_of_a_run_that_was_killed_early(tmp_path, monkeypatch):
    first = write_report(write_result(tmp_path / "r")).read_bytes()
    folder = (tmp_path / "r").rename(tmp_path / "moved")
    monkeypatch.chdir(tmp_path)
    assert write_report("moved").read_bytes() == first
    for path in [*(folder / "stats").iterdir(), *(folder / "report_data").iterdir()]:
        path.unlink()
    with open(folder / "metrics.jsonl", "a") as file:
        file.write('{"step": 290, "lo')
    Tags(write_report(folder).read_text(encoding="utf-8"))


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6), st.integers(2, 8))
def test_ticks_are_even_and_inside_the_axis(low: float, span: float, n: int) -> None:
    high = low + span
    if high <= low:
        return
    ticks = nice_ticks(low, high, n)
    slack = 1e-6 * max(span, abs(low))
    assert all(low - slack <= tick <= high + slack for tick in ticks)
    assert len(ticks) <= n + 1
    if len(ticks) > 2:
        np.testing.assert_allclose(np.diff(ticks), ticks[1] - ticks[0], rtol=1e-6, atol=slack)


@given(st.lists(st.one_of(st.floats(-1e9, 1e9), st.just(float("nan"))), max_size=12), st.booleans(), st.booleans())
def test_any_values_draw_without_leaving_the_plot(values: list[float], log: bool, zero: bool) -> None:
    series = Series("<s>", list(range(len(values))), values, "red", dots=True)
    chart = Chart("a & b", [series], 12, [Window("w", 0, 99, "blue")], [4], log, zero)
    svg = draw(chart)
    Tags(svg)
    assert "nan" not in re.sub(r'data-chart="[^"]*"', "", svg)
    heights = [float(y) for y in re.findall(r'cy="([-0-9.]+)"', svg)]
    assert all(0.0 <= y <= 220.0 for y in heights)


def test_very_small_and_very_large_numbers_have_an_axis_and_a_bar_taller_than_its_axis_is_cut() -> None:
    for value in (5e-324, 1e300):
        for log in (False, True):
            assert 'cy="' in draw(Chart("one", [Series("s", [0], [value], "red", dots=True)], 1, [], [], log, False))
    svg = draw_histogram("h", [0.0, 1.0, 0.0], 0.2, "red", ["note"])
    assert "100 %" in svg
    assert max(float(h) for h in re.findall(r'height="([0-9.]+)"', svg)) <= 180.0


def test_numbers_on_axes_are_short_and_a_mean_runs() -> None:
    short = {0.0: "0", 0.5: "0.5", 1200.0: "1.2k", 2.5e6: "2.5M", 2.5e-4: "2.5e-4", -3e-5: "-3e-5"}
    assert {value: short_number(value) for value in short} == short
    # a running mean forgets and skips what is not finite
    assert running_mean([1.0, 3.0, float("inf"), 5.0], 2) == [1.0, 2.0, 3.0, 5.0]


@given(st.integers(1, 2000))
def test_thinning_keeps_both_ends_and_order(n: int) -> None:
    steps, values = thin_out([float(i) for i in range(n)], [float(i) for i in range(n)], most=50)
    assert len(steps) <= 50
    assert steps[0] == 0.0
    assert steps[-1] == n - 1.0
    assert steps == sorted(set(steps)) == values


@given(st.lists(st.integers(0, 2**31 - 1), min_size=1, max_size=20))
def test_an_id_keeps_its_colour_and_no_one_is_black(ids: list[int]) -> None:
    array = np.array([[*ids, -1]])
    colors = images.id_colors(array)
    assert np.all(colors[0, -1] == 0)
    assert np.all(colors[0, :-1].max(axis=1) > 60)
    np.testing.assert_array_equal(images.id_colors(array[:, ::-1])[:, ::-1], colors)


def test_neighbouring_ids_get_different_colours_and_error_maps_share_one_scale() -> None:
    colors = images.id_colors(np.arange(1000).reshape(1, -1))[0].astype(int)
    assert (np.abs(np.diff(colors, axis=0)).sum(axis=1) > 20).mean() > 0.95
    # the scale of errors rises in brightness
    table = images.colormap_table().astype(float) @ [0.2126, 0.7152, 0.0722]
    assert np.all(np.diff(table) > -0.6)  # rounding to 8 bit
    photo = np.zeros((4, 4, 3), np.uint8)
    errors = [images.error_magnitude(np.full_like(photo, v), photo) for v in (0, 51)]
    assert images.error_scale(errors) == pytest.approx(0.2)
    assert np.all(images.error_picture(errors[0], 0.2) == images.colormap_table()[0])
    assert np.all(images.error_picture(errors[1], 0.2) == images.colormap_table()[-1])


def test_a_data_uri_holds_the_picture_shrunk_to_fit_and_never_enlarged() -> None:
    picture = np.kron(np.arange(16, dtype=np.uint8).reshape(4, 4)[..., None] * [3, 9, 15], np.ones((8, 8, 1)))
    picture = picture.astype(np.uint8)
    for lossless, off in ((True, 0), (False, 12)):
        data = base64.b64decode(images.data_uri(picture, lossless).partition(",")[2])
        back = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1].astype(int)
        assert np.abs(back - picture).max() <= off
    for shape, fitted in (((300, 900, 3), (200, 600, 3)), ((30, 90, 3), (30, 90, 3))):
        assert images.fit(np.zeros(shape, np.uint8), max_side=600).shape == fitted


# What the report says of a finished splat: floaters, exposure, depth, the orbit, the command.


def camera() -> View:
    """A camera at the origin that looks along z, a right angle wide."""
    return View("v", np.zeros((20, 20, 3), np.uint8), np.eye(4), np.array([[10.0, 0, 10], [0, 10, 10], [0, 0, 1]]))


def test_only_gaussians_nearer_than_half_the_way_to_the_nearest_points_are_near() -> None:
    points = np.array([[0.0, 0.0, z] for z in np.linspace(4.0, 8.0, 201)])
    outside = np.array([[9.0, 0.0, 1.0], [0.0, 0.0, -1.0]] * 50)
    assert near_limit(camera(), np.concatenate([points, outside])) == pytest.approx(2.04)
    assert near_limit(camera(), outside) is None
    params = {"means": torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [5.0, 0.0, 1.9], [0.0, 0.0, 2.1]])}
    assert nearer_than(params, camera(), 2.0)["means"][:, 2].tolist() == [1.0, pytest.approx(1.9)]
    # neighbours in a ring of twelve are thirty degrees apart
    assert neighbour_degrees(around(np.arange(0.0, 360.0, 30.0), 0.0)) == pytest.approx(30.0)
    assert neighbour_degrees(around(np.zeros(1), 0.0)) is None


def test_a_photograph_of_twice_the_light_is_one_stop_brighter() -> None:
    render = np.full((50, 3), 0.3)
    brighter = np.full((50, 3), 0.3 * 2.0 ** (1.0 / 2.2))
    assert stops_between(brighter, render) == pytest.approx(1.0)
    assert stops_between(render, render) == 0.0
    assert stops_between(np.zeros((50, 3)), render) == 0.0


@pytest.mark.parametrize("share", [0.01, 0.05, 0.2])
@pytest.mark.parametrize(("rest", "moved", "told"), [(0.01, 0.3, True), (0.03, 0.1, False), (0.005, 0.05, False)])
def test_what_moved_is_told_where_the_rest_fits(share: float, rest: float, moved: float, told: bool) -> None:
    generator = np.random.default_rng(3)
    photo = generator.integers(60, 160, (128, 256, 3), np.uint8)
    error = rest * generator.choice([-1.0, 1.0], photo.shape)
    side = round(np.sqrt(share * 128 * 256) / 8) * 8
    error[16 : 16 + side, 64 : 64 + side] = moved
    view = View("v", photo, np.eye(4), np.eye(3))
    found = misfit_share(view, photo / 255.0 + error)
    assert found == pytest.approx(side * side / (128 * 256) if told else 0.0, abs=1e-6)
    # neither what a mask leaves out counts, nor its pixels
    mask = np.ones((128, 256), bool)
    mask[16 : 16 + side, 64 : 64 + side] = False
    assert misfit_share(replace(view, mask=mask), photo / 255.0 + error) == 0.0
    assert misfit_share(replace(view, mask=np.zeros_like(mask)), photo / 255.0 + error) == 0.0


@pytest.mark.parametrize("brighter", [0.0, 0.05, 0.4])
def test_what_moved_over_detail_that_is_not_learned_is_told_by_its_colour(brighter: float) -> None:
    generator = np.random.default_rng(4)
    photo = generator.integers(60, 160, (144, 240, 3), np.uint8)
    # every pixel is off, one way and the other in turn, and all of it by another exposure; a patch has 10 x 10 pixels
    board = np.indices((144, 240)).sum(axis=0) % 2
    error = np.where(board, 0.2, -0.2)[..., None] + np.full(3, brighter)
    error[20:50, 100:120] += 0.1
    view = View("v", photo, np.eye(4), np.eye(3))
    render = photo / 255.0 + error
    assert misfit_share(view, render) == 0.0
    assert patch_share(view, render) == pytest.approx(6 / (14 * 24))
    mask = np.ones((144, 240), bool)
    mask[20:50, 100:120] = False
    assert patch_share(replace(view, mask=mask), render) == 0.0
    assert patch_share(replace(view, mask=np.zeros_like(mask)), render) == 0.0
    # where every second patch is off by as much, nothing is learned yet
    error[:, (np.arange(240) // 10) % 2 == 0] += 0.1
    assert patch_share(view, photo / 255.0 + error) == 0.0


def test_a_training_leaves_what_its_report_shows(shared_result: Path, shared_capture: Path) -> None:
    found = read_checks(shared_result / "report_data" / "checks_step29.json")
    assert found.given == found.placed == 8
    assert found.patches.keys() == found.misfits.keys() != set()
    stats = json.loads((shared_result / "stats" / "val_step0029.json").read_text())
    assert found.photographs == 7
    assert found.held_out_psnr == pytest.approx(stats["psnr"], abs=1e-3)
    assert set(found.stops) == {view.name for view in load_capture(shared_capture).views}
    orbit = shared_result / "videos" / "orbit_step29.webm"
    assert frames_in(orbit) == 60
    assert cv2.VideoCapture(str(orbit)).read()[1].std() > 5.0
    page = (shared_result / "report.html").read_text()
    assert f"held-out views {found.held_out_psnr:.2f} dB" in text_of(page)
    assert f"pop train {shared_capture} --out {shared_result} {' '.join(TRAIN_AND_CHECK)}" in text_of(page)
    assert '<a href="ply/point_cloud_29.ply">' in page
    assert 'src="data:video/webm;base64,' in page


class Looked:
    """The tiny result with its capture, looked at again."""

    def __init__(self, folder: Path, capture: Path) -> None:
        self.folder, self.splat, self.capture = folder, load_splat(folder), load_capture(capture)

    def checks(self, params: dict | None = None, step: int = 29, **settings: Any) -> Checks:
        config = self.splat.config.with_overrides(**settings) if settings else self.splat.config
        given = (self.splat.params if params is None else params, config, self.splat.sh_degree)
        return write_checks(self.folder, self.capture, *given, renderer("auto")[0], step)

    def with_one(self, view: View, distance: float, size: float) -> dict[str, torch.Tensor]:
        """Plant a Gaussian in front of a camera."""
        place = torch.from_numpy(view.camera_center + distance * view.viewmat[2, :3]).float()
        row = {"means": place, "scales": torch.full((3,), float(np.log(size))), "opacities": torch.tensor(3.0)}
        return {n: torch.cat([t, (row[n] if n in row else t[0])[None]]) for n, t in self.splat.params.items()}


@pytest.fixture
def looked(result: Path, shared_capture: Path, monkeypatch: pytest.MonkeyPatch) -> Looked:
    # film four frames
    monkeypatch.setattr(checks, "_ORBIT_FRAMES", 4)
    return Looked(result, shared_capture)


def test_a_gaussian_in_front_of_a_camera_is_a_floater(looked: Looked) -> None:
    view = looked.capture.test_views()[0]
    before = read_checks(looked.folder / "report_data" / "checks_step29.json").floaters[view.name]
    near = 0.3 * near_limit(view, looked.capture.points)
    found = looked.checks(looked.with_one(view, near, 0.1 * near))
    assert found.floaters[view.name] > before + 0.02
    # and only there
    assert {name for name, share in found.floaters.items() if share > 0.02} == {view.name}
    stats = json.loads((looked.folder / "stats" / "val_step0029.json").read_text())
    assert found.held_out_psnr < stats["psnr"] - 0.02
    assert found.without_floaters == pytest.approx(stats["psnr"], abs=1e-3)


def test_a_veil_between_the_photographs_is_found(looked: Looked) -> None:
    capture, config = looked.capture, looked.splat.config
    turn = checks.orbit_views(capture.train_views())
    limit = near_limit(turn[1], capture.points)
    # so near to the camera of the orbit, and so small, that only it sees the veil
    params = looked.with_one(turn[1], 0.06 * limit, 0.012 * limit)
    before, found = looked.checks(), looked.checks(params)
    worst = turn[1].name
    assert found.orbit_floaters[worst] > before.orbit_floaters[worst] + 0.02
    # the photographs' own views, which were all that was looked at, show nothing of it
    assert found.floaters == pytest.approx(before.floaters, abs=0.01)
    told = [one for one in verdict({}, found, None) if one.about == "Floaters"]
    assert told[0].kind != "good"
    assert told[0].next == ("export", "RESULT", "--to", "html", "--without-floaters")
    # what it says to type takes the veil away, and little else
    gone = are_floaters(params["means"], capture, config.test_every)
    assert gone[-1]
    assert gone.float().mean() < 0.05
    after = looked.checks({name: tensor[~gone] for name, tensor in params.items()})
    assert max(after.orbit_floaters.values()) <= max(before.orbit_floaters.values())
    assert after.orbit_floaters[worst] < 0.01
    assert after.held_out_psnr > before.held_out_psnr - 0.1


def test_a_veil_that_reaches_in_from_outside_is_left_out_and_the_rest_is_tuned(
    looked, pop, shared_capture, tmp_path, monkeypatch
):
    capture, splat = looked.capture, looked.splat
    turn = checks.orbit_views(capture.train_views())[1]
    limit = near_limit(turn, capture.points)
    # its centre is beside the picture, half as far again as the border
    beside = 0.06 * limit * 0.75 * turn.width / turn.K[0, 0]
    params = looked.with_one(turn, 0.06 * limit, 0.012 * limit)
    params["means"][-1] += torch.from_numpy(beside * turn.viewmat[0, :3]).float()
    assert not are_floaters(params["means"], capture, splat.config.test_every)[-1]
    veils = are_veils(params, capture, splat.config, splat.sh_degree, renderer("auto")[0])
    assert veils[-1]
    # those of a splat that is hardly trained reach into a picture here and there
    assert veils.float().mean() < 0.2
    save_ply(tmp_path / "veiled.ply", params, frame=Frame("training"))
    words = ("export", tmp_path / "veiled.ply", "--capture", shared_capture, "--without-floaters", "--out")
    plain = pop.done(*words, tmp_path / "a.ply", "--fine-tune-steps", "0").out
    assert "without veils" not in plain
    said = pop.done(*words, tmp_path / "b.ply", "--fine-tune-steps", "20").out
    assert "without veils: " in said
    after, before = map(float, re.findall(r"([\d.]+) dB", said)[-2:])
    assert after > before - 0.1
    # what tuning brings back is left out again
    monkeypatch.setattr("pop_fast.train.compact.tuned_to_the_end", lambda _: params)
    said = pop.done(*words, tmp_path / "c.ply", "--fine-tune-steps", "20").out
    many = len(params["means"])
    assert f"without what grew meanwhile: {many - int(veils.sum()):,} of {many:,} Gaussians kept" in said


@pytest.mark.parametrize("most", [3, 40])
def test_veils_are_weighed_by_all_that_is_seen_in_an_even_selection_of_the_training_views(looked, monkeypatch, most):
    monkeypatch.setattr(checks, "_MOST_WEIGHED", most)
    capture, config, degree = looked.capture, looked.splat.config, looked.splat.sh_degree
    backend, drawn, whole = renderer("auto")[0], {}, Passes.contributions

    def watched(self: Passes, params: dict, *rest: Any) -> ViewContributions:
        drawn[self.view(0).name] = len(params["means"])
        return whole(self, params, *rest)

    monkeypatch.setattr(Passes, "contributions", watched)
    train = capture.train_views(config.test_every)
    turn = checks.orbit_views(train)
    params = looked.with_one(turn[1], 0.06 * near_limit(turn[1], capture.points), 0.012)
    found = are_veils(params, capture, config, degree, backend)
    n = len(params["means"])
    some = [train[i] for i in ((0, 3, 6) if most == 3 else range(7))]
    assert [view.name for view in train if view.name in drawn] == [view.name for view in some]
    assert all(drawn[view.name] == n for view in some)
    # views of the orbit are drawn without what stands behind, and that changes nothing
    assert all(drawn.get(view.name, 0) < n for view in turn)
    hidden, shown = torch.zeros(n).double(), torch.zeros(n).double()
    for sums, views, is_near in ((hidden, turn, True), (shown, some, False)):
        for view in views:
            seen = whole(Passes.of(backend, [ViewTensors.of(view)], config), params, 0, degree)
            counts = (seen.depths < near_limit(view, capture.points)) == is_near
            sums += torch.where(counts, seen.weight_sum, 0.0) / (view.width * view.height * len(views))
    assert torch.equal(found, (hidden > 1e-5) & (hidden > shown))
    assert found[-1]


def test_floaters_are_left_out_of_a_file_by_their_places(pop, shared_result, shared_capture, tmp_path):
    params, view = load_splat(shared_result).params, load_capture(shared_capture).views[3]
    place = torch.from_numpy(view.camera_center + 0.05 * view.viewmat[2, :3]).float()
    planted = {name: torch.cat([t, (place if name == "means" else t[0])[None]]) for name, t in params.items()}
    save_ply(tmp_path / "planted.ply", planted, frame=Frame("training"))
    words = ("export", tmp_path / "planted.ply", "--out", tmp_path / "a.ply", "--without-floaters")
    many = len(params["means"])
    said = pop.done(*words, "--capture", shared_capture).out
    assert f"without floaters: {many:,} of {many + 1:,} Gaussians kept" in said
    says(pop(*words, "--overwrite"), "finding floaters needs the cameras; give --capture")
    # what points that were made up say of them is refused
    capture = replace(tiny_capture(), source="no points: 60 random ones (seed 0)")
    with pytest.raises(PopError, match="no sparse points of its own"):
        are_floaters(torch.zeros(1, 3), capture, 8)


def test_the_worst_views_come_first_and_have_pictures_whatever_was_kept(looked: Looked) -> None:
    looked.checks(test_every=2, max_renders=1)
    views = read_result(looked.folder).views
    assert [view.psnr for view in views] == sorted(view.psnr for view in views)
    assert len(views) == 2
    assert all(view.depth is not None and np.nanmin(view.depth) > 0.0 for view in views)


def test_training_views_are_measured_with_what_the_run_learned_of_their_photographs(looked: Looked) -> None:
    def measured(learned: dict | None) -> Checks:
        text = json.dumps({view.name: learned for view in looked.capture.train_views()})
        (looked.folder / "stats" / "appearance_step0029.json").write_text(text if learned is not None else "{}")
        return looked.checks()

    plain, same = measured(None), measured({"exposure": np.eye(3, 4).tolist()})
    assert (plain.exposures_learned, same.exposures_learned) == (False, True)
    assert same.train_psnr == pytest.approx(plain.train_psnr, abs=1e-4)
    assert read_checks(looked.folder / "report_data" / "checks_step29.json") == same
    dark = measured({"exposure": (0.25 * np.eye(3, 4)).tolist()})
    assert dark.train_psnr < plain.train_psnr - 1.0
    # what a photograph differs by is told without, and held-out views have none
    assert dark.stops == pytest.approx(plain.stops)
    assert dark.held_out_psnr == plain.held_out_psnr
    away = np.eye(4)
    away[2, 3] = -1e3
    assert measured({"viewmat": away.tolist()}).train_psnr < plain.train_psnr - 1.0


def test_a_run_that_was_stopped_is_shown_as_it_was_then(looked: Looked) -> None:
    for path in (looked.folder / "report_data").glob("val_*"):
        path.unlink()
    found, data = looked.checks(step=19), read_result(looked.folder)
    assert [view.name for view in data.views] == [view.name for view in looked.capture.test_views()]
    assert f"{found.held_out_psnr:.2f} dB on average" in data.verdict[0].text


def test_a_resumed_run_has_all_its_commands(pop: Pop, result: Path, shared_capture: Path) -> None:
    words = ("train", shared_capture, "--out", result, *TRAIN, "--resume", "--skip-sizes", "--skip-checks")
    pop.done(*words)
    first, second = json.loads((result / "commands.json").read_text())
    assert "These commands made the result." in (result / "report.html").read_text()
    assert first["words"][:2] == ["pop", "train"]
    assert first["words"][-2:] == list(TRAIN_AND_CHECK[-2:])
    assert second["words"] == ["pop", *map(str, words)]


def test_checks_of_a_run_that_went_on_are_not_shown_as_its_last(looked: Looked) -> None:
    measured = max((looked.folder / "stats").glob("val_step*.json"))
    later = {**json.loads(measured.read_text()), "step": 99, "psnr": 42.0}
    measured.with_name("val_step99.json").write_text(json.dumps(later))
    data = read_result(looked.folder)
    assert (data.checked, data.orbit) == (False, None)
    assert [finding.about for finding in data.verdict] == ["Quality"]
    assert "42.00 dB on average" in data.verdict[0].text
    assert all(view.depth is None for view in data.views)


def test_checks_without_a_training_view_are_refused_in_one_line(pop: Pop, looked: Looked) -> None:
    says(pop("report", looked.folder, "--check", "--test-every", "1"), "every view is held out")


def test_a_run_without_checks_says_how_to_get_them(pop: Pop, looked: Looked) -> None:
    (looked.folder / "report_data" / "checks_step29.json").unlink()
    (looked.folder / "videos" / "orbit_step29.webm").unlink()
    for words, shown in ((), False), (("--check",), True):
        pop.done("report", looked.folder, *words)
        page = (looked.folder / "report.html").read_text()
        assert ("pop report RESULT --check" in page, "<video" in page) == (not shown, shown)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("report_data/checks_step29.json", "{}", "missing 3 required"),
        ("report_data/checks_step29.json", '{"photographs": "many"}', "photographs is not what a run writes"),
        ("report_data/checks_step29.json", '{"stops": {"a": null}}', "stops is not what a run writes"),
        ("commands.json", '{"words": []}', "is not a list of commands"),
        ("commands.json", "[", "is not JSON"),
    ],
)
def test_damage_is_named_and_leaves_the_report_as_it_was(result: Path, name: str, text: str, said: str) -> None:
    before = (result / "report.html").read_bytes()
    (result / name).write_text(text)
    with pytest.raises(PopError, match=re.escape(said)):
        write_report(result)
    assert (result / "report.html").read_bytes() == before


def test_depth_maps_share_a_range_that_outliers_do_not_set() -> None:
    depth = np.concatenate([np.linspace(2.0, 4.0, 1000), [900.0] * 5, [np.nan] * 20]).reshape(-1, 5)
    near, far = depth_range([depth])
    assert near == pytest.approx(2.02, abs=0.01)
    assert far == pytest.approx(4.0, abs=0.02)
    picture = depth_picture(depth, near, far)
    assert np.ptp(picture[-1], axis=0).max() == 0  # NaN in grey
    assert picture[0, 0].sum() > picture[199, 4].sum()  # near is bright
    # equal ratios are equal steps
    one, two, four = (depth_picture(np.array([[value]]), 1.0, 16.0)[0, 0].tolist() for value in (1.0, 4.0, 16.0))
    table = colormap_table("viridis_r").tolist()
    assert [one, two, four] == [table[0], table[128], table[255]]
    assert depth_range([]) == (0.1, 1.0)


# the charts whose values under the pointer, at a share of the chart's width, stick out of the window
TIPS_FIT = """share => [...document.querySelectorAll('[data-chart]')].filter(chart => {
  const box = chart.querySelector('svg').getBoundingClientRect(), clientX = box.left + share * box.width;
  chart.querySelector('svg').dispatchEvent(new PointerEvent('pointermove', {clientX}));
  const tip = chart.querySelector('.tip'), {left, right} = tip.getBoundingClientRect();
  return tip.hidden || left < 0 || right > innerWidth;
}).map(chart => chart.textContent)"""


def test_the_slider_uncovers_the_photograph_and_the_orbit_plays(shared_result: Path, tmp_path: Path) -> None:
    with browser(tmp_path / "browser") as tab:
        tab.open(shared_result / "report.html", 1000, 800)
        tab.wait_for("document.readyState === 'complete'")
        clip = "getComputedStyle(document.querySelector('.slider .over')).clipPath"
        assert tab.value(clip) == "inset(0px 0px 0px 50%)"
        tab.value(
            "(i => { i.value = 20; i.dispatchEvent(new Event('input')) })(document.querySelector('.slider input'))"
        )
        assert tab.value(clip) == "inset(0px 0px 0px 20%)"
        tab.wait_for("document.querySelector('video').readyState >= 2")
        assert tab.value("document.querySelector('video').duration") == pytest.approx(4.0, abs=0.2)
        # no picture comes late and moves what is being read
        assert tab.value("[...document.images].every(each => each.naturalWidth > 0)")
        tab.call("Emulation.setDeviceMetricsOverride", width=320, height=800, deviceScaleFactor=1, mobile=True)
        for share in (0.15, 0.45, 0.55, 0.95):
            assert tab.value(f"({TIPS_FIT})({share})") == []
        assert tab.errors == []
        assert all(url.startswith(("file:", "blob:", "about:", "data:")) for url in tab.requests)


# A small result folder as `pop train` leaves it, made without training.

VIEWS = ("a.png", "b.png")


def write_result(folder: Path, method: str = "pop", steps: int = 300, **stats: Any) -> Path:
    """Write cfg.json, metrics.jsonl, stats and report_data of a made-up run of `steps` steps; returns the folder."""
    config = TrainConfig.of(data="captures/toy", method=method, steps_scaler=steps / 30_000)
    for name in ("stats", "report_data"):
        (folder / name).mkdir(parents=True)
    (folder / "cfg.json").write_text(config.to_json())
    rng = np.random.default_rng(0)
    with open(folder / "metrics.jsonl", "w") as file:
        for step in range(0, steps, 10):
            file.write(json.dumps(_record(step, steps, rng)) + "\n")
    measured = {"psnr": 24.5, "ssim": 0.81, "lpips": None, "lpips_reason": "no weights were given", **stats}
    last = steps - 1
    base = {"step": last, "num_GS": 1200, "num_GS_above_floor": 1100, "seconds": 30.0, "machine": "a machine"}
    opacity = {"opacity_below_0.1": 0.25, "opacity_above_0.9": 0.5}
    (folder / "stats" / f"train_step{last:04d}.json").write_text(json.dumps({**base, **opacity}))
    (folder / "stats" / f"val_step{last:04d}.json").write_text(json.dumps({**base, **opacity, **measured}))
    edges = np.linspace(0.0, 1.0, 101)
    for step, sample in ((-1, np.full(50, 0.1)), (69, rng.beta(1, 1, 500)), (last, rng.beta(0.3, 0.3, 500))):
        counts = np.histogram(sample, edges)[0]
        np.savez(folder / "report_data" / f"opacity_step{step}.npz", step=step, counts=counts, edges=edges)
    for i, name in enumerate(VIEWS):
        photo = rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)
        render = np.clip(photo.astype(int) + rng.integers(-9, 9, photo.shape), 0, 255).astype(np.uint8)
        ids = rng.integers(-1, 40, (24, 32)).astype(np.int32)
        arrays = {"name": name, "render": render, "photo": photo, "dominant_ids": ids, "psnr": 24.0 + i, "ssim": 0.8}
        np.savez(folder / "report_data" / f"val_step{last}_{i}.npz", **arrays)
    return folder


def _record(step: int, steps: int, rng: np.random.Generator) -> dict[str, Any]:
    record: dict[str, Any] = {
        "step": step,
        "loss": 0.1 / (1 + step / 50) + 0.001 * float(rng.random()),
        "psnr": 15.0 + 10.0 * step / steps,
        "num_gaussians": 1000 + step,
        "n_blended": 20.0 - step / steps,
        "n_traversed": 40.0 - step / steps,
    }
    if step in (20, 40):
        record |= {"cloned": 5, "split": 3, "pruned": 2}
    if step == 40:
        record["reset"] = True
    return record
