"""report.html: what it shows, what it is made from, and that it needs nothing but itself."""

from __future__ import annotations

import base64
import json
import re
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pop_fast.errors import PopError
from pop_fast.io import pictures
from pop_fast.view.report import write_report
from pop_fast.view.report.curves import Chart, Series, Window, draw, draw_histogram, nice_ticks, short_number
from pop_fast.view.report.source import read_result, running_mean, thin_out
from tests.app.result_folder import VIEWS, write_result


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


def test_the_page_is_well_formed_and_loads_nothing_from_elsewhere(html: str) -> None:
    tags = Tags(html).seen
    sources = [value for _, attrs in tags for key, value in attrs.items() if key in ("src", "href") and value]
    assert sources
    links = {"cfg.json", "metrics.jsonl"}
    assert all(source.startswith("data:image/") for source in set(sources) - links)
    assert links < set(sources)
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", html)
    assert "@import" not in html


def test_headline_numbers_are_those_of_the_stats_file(html: str) -> None:
    text = unescape(re.sub(r"<[^>]+>", " ", html))
    for number in ("24.50", "0.8100", "1,200", "1,100 with opacity", "no weights were given", "10.0 iterations"):
        assert number in text, number
    assert f"{1200 * 236 / 2**20:.1f}" in text
    assert f"as PLY {1200 * 248 / 2**20:.1f}" in text


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


def test_schedule_windows_are_those_that_ran(html: str) -> None:
    text = unescape(re.sub(r"<[^>]+>", " ", html))
    assert "density control 5–150" in text
    assert "blur densification 30–70" in text
    assert "POP loss 0–150" in text
    assert "opacity reset at 40" in text


def test_plain_density_control_shows_no_blur_and_no_pop_window(tmp_path: Path) -> None:
    names = [window.name for window in read_result(write_result(tmp_path / "r", method="gsplat")).windows]
    assert names == ["density control"]


def test_histograms_stand_for_start_middle_and_end(tmp_path: Path) -> None:
    histograms = read_result(write_result(tmp_path / "r")).histograms
    assert [h.title for h in histograms] == ["start", "iteration 70", "end"]
    assert histograms[0].share_between(0.1, 0.2) == 1.0
    assert sum(histograms[2].shares) == pytest.approx(1.0)


def test_every_held_out_view_is_shown_as_render_photo_and_error(html: str) -> None:
    alts = [attrs["alt"] for tag, attrs in Tags(html).seen if tag == "img"]
    for name in VIEWS:
        assert [f"{what} of {name}" in alts for what in ("render", "photo", "error")] == [True] * 3
    assert f"dominant Gaussians of {VIEWS[0]}" in alts


def test_densification_steps_and_settings_are_in_the_record(html: str) -> None:
    text = unescape(re.sub(r"<[^>]+>", " ", html))
    assert "Densification steps (2)" in text
    assert "pop.theta_blur" in text


def test_the_report_reads_only_the_result_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = write_report(write_result(tmp_path / "r")).read_bytes()
    (tmp_path / "r").rename(tmp_path / "moved")
    monkeypatch.chdir(tmp_path)
    assert write_report("moved").read_bytes() == first


def test_a_run_that_was_killed_early_still_gets_a_report(tmp_path: Path) -> None:
    folder = write_result(tmp_path / "r")
    for path in [*(folder / "stats").iterdir(), *(folder / "report_data").iterdir()]:
        path.unlink()
    with open(folder / "metrics.jsonl", "a") as file:
        file.write('{"step": 290, "lo')
    Tags(write_report(folder).read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda r: (r / "cfg.json").unlink(), "has no cfg.json"),
        (lambda r: (r / "metrics.jsonl").write_text('{"step": 1\n{"step": 2}\n'), "line 1 is not JSON"),
        (lambda r: (r / "stats" / "val_step0299.json").write_text("{"), "val_step0299.json: is not JSON"),
        (lambda r: (r / "report_data" / "opacity_step69.npz").write_bytes(b"PK"), "opacity_step69.npz: is damaged"),
    ],
)
def test_a_damaged_result_is_named_and_leaves_no_report(tmp_path: Path, damage, message: str) -> None:
    folder = write_result(tmp_path / "r")
    damage(folder)
    with pytest.raises(PopError, match=re.escape(message)):
        write_report(folder)
    assert not (folder / "report.html").exists()


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


@given(
    st.lists(st.one_of(st.floats(-1e9, 1e9), st.just(float("nan"))), max_size=12),
    st.booleans(),
    st.booleans(),
)
def test_any_values_draw_without_leaving_the_plot(values: list[float], log: bool, zero: bool) -> None:
    series = Series("<s>", list(range(len(values))), values, "red", dots=True)
    chart = Chart("a & b", [series], 12, [Window("w", 0, 99, "blue")], [4], log, zero)
    svg = draw(chart)
    Tags(svg)
    assert "nan" not in re.sub(r'data-chart="[^"]*"', "", svg)
    heights = [float(y) for y in re.findall(r'cy="([-0-9.]+)"', svg)]
    assert all(0.0 <= y <= 220.0 for y in heights)


@pytest.mark.parametrize("value", [5e-324, 1e300])
@pytest.mark.parametrize("log", [False, True])
def test_very_small_and_very_large_numbers_have_an_axis(value: float, log: bool) -> None:
    assert 'cy="' in draw(Chart("one", [Series("s", [0], [value], "red", dots=True)], 1, [], [], log, False))


def test_a_bar_taller_than_its_axis_is_cut_and_says_so() -> None:
    svg = draw_histogram("h", [0.0, 1.0, 0.0], 0.2, "red", ["note"])
    assert "100 %" in svg
    assert max(float(h) for h in re.findall(r'height="([0-9.]+)"', svg)) <= 180.0


def test_numbers_on_axes_are_short() -> None:
    assert [short_number(v) for v in (0.0, 0.5, 1200.0, 2.5e6, 2.5e-4, -3e-5)] == [
        *("0", "0.5", "1.2k", "2.5M", "2.5e-4", "-3e-5"),
    ]


def test_running_mean_forgets_and_skips_what_is_not_finite() -> None:
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
    colors = pictures.id_colors(array)
    assert np.all(colors[0, -1] == 0)
    assert np.all(colors[0, :-1].max(axis=1) > 60)
    np.testing.assert_array_equal(pictures.id_colors(array[:, ::-1])[:, ::-1], colors)


def test_neighbouring_ids_get_different_colours() -> None:
    colors = pictures.id_colors(np.arange(1000).reshape(1, -1))[0].astype(int)
    assert (np.abs(np.diff(colors, axis=0)).sum(axis=1) > 20).mean() > 0.95


def test_error_maps_share_one_scale_that_rises_in_brightness() -> None:
    table = pictures.colormap_table().astype(float) @ [0.2126, 0.7152, 0.0722]
    assert np.all(np.diff(table) > -0.6)  # rounding to 8 bit
    photo = np.zeros((4, 4, 3), np.uint8)
    errors = [pictures.error_magnitude(np.full_like(photo, v), photo) for v in (0, 51)]
    assert pictures.error_scale(errors) == pytest.approx(0.2)
    assert np.all(pictures.error_picture(errors[0], 0.2) == pictures.colormap_table()[0])
    assert np.all(pictures.error_picture(errors[1], 0.2) == pictures.colormap_table()[-1])


@pytest.mark.parametrize("lossless", [True, False])
def test_a_data_uri_holds_the_picture(lossless: bool) -> None:
    picture = np.kron(np.arange(16, dtype=np.uint8).reshape(4, 4)[..., None] * [3, 9, 15], np.ones((8, 8, 1)))
    picture = picture.astype(np.uint8)
    data = base64.b64decode(pictures.data_uri(picture, lossless).partition(",")[2])
    back = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1].astype(int)
    assert np.abs(back - picture).max() <= (0 if lossless else 12)


def test_pictures_are_shrunk_to_fit_and_never_enlarged() -> None:
    assert pictures.fit(np.zeros((300, 900, 3), np.uint8), max_side=600).shape == (200, 600, 3)
    assert pictures.fit(np.zeros((30, 90, 3), np.uint8), max_side=600).shape == (30, 90, 3)
