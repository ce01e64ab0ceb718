"""`pop explain`: its numbers are rasterization's and autograd's, and it says what to do about bad input."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import cuda_ext
import pop_fast
from pop_fast.api.backend import BACKENDS, get_backend
from pop_fast.api.backends import FAST, TorchBackend
from pop_fast.api.rasterize import rasterization
from pop_fast.cli.explain import chosen_view
from pop_fast.density import POPStrategy
from pop_fast.errors import PopError
from pop_fast.stages.losses import photometric_3dgs, photometric_pop
from pop_fast.train.config import TrainConfig
from pop_fast.view.explain import ExplainedView, explain_pixel, explain_view
from pop_fast.view.explain.diff import difference, first_flip
from pop_fast.view.explain.pixel import WIDTH, candidates, oracle_splats, table, walk
from pop_fast.view.explain.scene import settings_of, termination_depths, with_objective
from pop_ref.constants import PAPER, PROFILES, Profile
from pop_ref.records import Splats
from tests.app.conftest import Outcome, Pop
from tests.app.damage import says
from tests.app.tiny import tiny_capture
from tests.browser import browser

VIEW = tiny_capture().views[1]
PIXELS = [(x, y) for y in range(0, VIEW.height, 6) for x in range(0, VIEW.width, 4)]
AXIS = VIEW.camera_center / np.linalg.norm(VIEW.camera_center)
MIXED = {"background": (0.25, 0.5, 0.75)}


def params(n: int = 120, seed: int = 3) -> dict[str, torch.Tensor]:
    """Splats of all sizes, from fainter than the floor to more opaque than the ceiling; the first is a backdrop."""
    g = torch.Generator().manual_seed(seed)
    made = {
        "means": torch.rand((n, 3), generator=g) * 2.0 - 1.0,
        "scales": torch.rand((n, 3), generator=g) * 2.4 - 2.8,
        "quats": torch.randn((n, 4), generator=g),
        "opacities": torch.rand((n,), generator=g) * 20.0 - 7.0,
        "sh0": torch.randn((n, 1, 3), generator=g),
        "shN": torch.randn((n, 15, 3), generator=g) * 0.1,
    }
    made["means"][0] = torch.from_numpy(-1.5 * AXIS)
    made["scales"][0], made["opacities"][0] = 1.5, 12.0
    return made


@pytest.fixture(scope="module")
def scene() -> ExplainedView:
    """The made-up splat in one view, over a background that is not black."""
    return explain_view(params(), VIEW, TrainConfig(**MIXED))


@pytest.mark.parametrize("changes", [{}, {"profile": "inria"}, {"antialiased": True}], ids=["paper", "inria", "mip"])
def test_the_oracle_on_a_few_gaussians_agrees_with_rasterization_of_all(changes: dict[str, object]) -> None:
    view = explain_view(params(), VIEW, TrainConfig(**MIXED, **changes))  # type: ignore[arg-type]
    statuses = set()
    for x, y in PIXELS:
        e = explain_pixel(view, x, y)
        np.testing.assert_allclose(e.color, view.image[y, x], rtol=0, atol=1e-12)
        assert e.T_final == pytest.approx(float(view.info["final_T"][0, y, x]), abs=1e-12)
        assert e.dominant_id == int(view.info["dominant_ids"][0, y, x])
        assert len(e.blended) == int(view.info["n_contrib"][0, y, x])
        assert e.n_traversed == int(view.info["n_traversed"][0, y, x])
        statuses |= {row.status for row in e.rows} | {"clamped" for row in e.rows if row.clamped}
    assert statuses == {"blended", "skipped", "stopped", "hidden", "clamped"}


def test_weights_and_what_is_left_sum_to_one_and_rays_end_at_the_depth_of_who_stopped_them(scene):
    depths, ended = termination_depths(scene), []
    for x, y in PIXELS:
        e = explain_pixel(scene, x, y)
        assert sum(row.weight for row in e.rows) + e.T_final == pytest.approx(1.0, abs=1e-12)
        behind = np.array(e.background) * e.T_final
        np.testing.assert_allclose(e.rows[-1].cumulative + behind, e.color, rtol=0, atol=1e-12)
        heaviest = max(e.blended, key=lambda row: row.weight)
        assert [row.id for row in e.rows if row.dominant] == [heaviest.id] == [e.dominant_id]
        ended.append(np.nan if e.stopped_by is None else e.stopped_by.depth)
    np.testing.assert_allclose([depths[y, x] for x, y in PIXELS], ended, rtol=1e-12)
    assert 0 < np.isfinite(ended).sum() < len(ended)


def test_listed_derivatives_are_those_of_autograd(scene: ExplainedView) -> None:
    for x, y in PIXELS[::5]:
        e = explain_pixel(scene, x, y)
        alphas = torch.tensor([row.alpha for row in e.blended], dtype=torch.float64, requires_grad=True)
        left = torch.cat([torch.ones(1, dtype=torch.float64), torch.cumprod(1.0 - alphas, 0)])
        colors = torch.tensor([row.color for row in e.blended], dtype=torch.float64)
        color = ((left[:-1] * alphas)[:, None] * colors).sum(0) + left[-1] * scene.background
        (v_alphas,) = torch.autograd.grad(color @ scene.v_image[y, x], alphas)
        np.testing.assert_allclose([row.v_alpha for row in e.blended], v_alphas, rtol=1e-9, atol=1e-18)


def test_derivatives_through_single_pixels_sum_to_the_views() -> None:
    small = replace(VIEW, image=VIEW.image[:12, :14], K=VIEW.K - [[0, 0, 9], [0, 0, 6], [0, 0, 0]])
    view = explain_view(params(40), small, TrainConfig(**MIXED, antialiased=True))
    total = np.zeros(40)
    for y, x in np.ndindex(12, 14):
        for row in explain_pixel(view, x, y).rows:
            total[row.id] += row.v_opacity
    np.testing.assert_allclose(total, view.v_opacities, rtol=1e-9, atol=1e-16)
    assert np.count_nonzero(total) > 10


def test_the_views_derivatives_are_those_of_the_loss_that_is_trained(scene: ExplainedView) -> None:
    opacities = scene.gaussians["opacities"].clone().requires_grad_(True)
    given = {**scene.gaussians, "opacities": opacities, "colors": scene.gaussians["sh"]}
    del given["sh"]
    settings = settings_of(scene.view, scene.config, torch.float64)
    target = torch.from_numpy(VIEW.image).double() / 255.0
    with torch.enable_grad():
        image = rasterization(**given, **settings, sh_degree=3, backgrounds=scene.background[None])[0][0]
        prior = POPStrategy().regularizer(opacities, {"dominant_sum": None}, 0, {"dominant_counts": scene.counts[None]})
        (v,) = torch.autograd.grad(photometric_pop(image, target) + prior, opacities)
    rows = {row.id: row for x, y in PIXELS for row in explain_pixel(scene, x, y).rows}
    assert len(rows) > 60
    for i, row in rows.items():
        assert row.v_opacity_view + row.v_opacity_pop == pytest.approx(float(v[i]), rel=1e-9, abs=1e-16)
        assert row.pop == ("up" if row.pixels_dominated > 0 else "down")
        assert row.net == ("up" if v[i] < 0 else "down")


def test_the_table_fits_a_terminal_and_shows_every_entry_when_asked(scene: ExplainedView) -> None:
    for x, y in PIXELS:
        e = explain_pixel(scene, x, y)
        for text in (str(e), table(e, everything=True)):
            assert max(map(len, text.splitlines())) <= WIDTH
            assert not re.search(r"\bnan\b", text)
        ranks = re.findall(r"^[* ] +(\d+) ", table(e, everything=True).partition("---")[2], re.MULTILINE)
        assert ranks == [str(row.rank) for row in e.rows]
        dominant = next(row for row in e.rows if row.dominant)
        assert re.search(rf"^\* +{dominant.rank} +{dominant.id} ", str(e), re.MULTILINE)
        if e.stopped_by:
            assert "stopped, D7: would leave T" in str(e)


def test_a_pixel_that_nothing_reaches_is_background() -> None:
    far = params(5)
    far["means"] = far["means"] + 100.0
    e = explain_pixel(far, 3, 4, view=VIEW, config=TrainConfig(**MIXED))
    assert (e.color, e.rows, e.dominant_id, e.T_final) == ((0.25, 0.5, 0.75), (), -1, 1.0)
    assert "nothing is blended here" in str(e)


def test_json_holds_every_number(scene: ExplainedView) -> None:
    e = explain_pixel(scene, 16, 12)
    plain = json.loads(e.to_json())
    assert plain["format"] == "pop-explain/1"
    assert len(plain["rows"]) == len(e.rows)
    row = plain["rows"][2]
    assert (row.pop("pop"), row.pop("net")) == (e.rows[2].pop, e.rows[2].net)
    assert row == json.loads(json.dumps(asdict(e.rows[2])))


def flipped(scene: ExplainedView, profile: Profile, change: dict[str, np.ndarray] | None = None) -> str | None:
    """Walk the middle under the paper's profile and, changed, under another; name the first decision that differs."""
    x, y = 16, 12
    ids = candidates(scene.info, x, y)
    a, b = oracle_splats(scene, ids, PAPER), oracle_splats(scene, ids, profile)
    if change:
        b = Splats(**({name: getattr(b, name) for name in Splats.__dataclass_fields__} | change))
    walks = walk(scene, a, x, y, PAPER), walk(scene, b, x, y, profile)
    flip = first_flip(ids, walks, (PAPER, profile))
    return None if flip is None else flip.decision


def test_the_decision_that_flipped_is_named() -> None:
    # four round splats on the axis of a camera, each at its own depth; the third ends the ray
    four = params(4)
    four["means"] = torch.tensor(np.outer([0.6, 0.2, -0.2, -0.6], AXIS))
    four["scales"] = torch.full((4, 3), -2.0)
    centred = replace(VIEW, K=VIEW.K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]))
    four["opacities"] = torch.logit(torch.tensor([0.3, 0.9995, 0.95, 0.5], dtype=torch.float64))
    scene = explain_view(four, centred)
    e = explain_pixel(scene, 16, 12)
    assert [row.status for row in e.rows] == ["blended", "blended", "stopped", "hidden"]
    splats = oracle_splats(scene, candidates(scene.info, 16, 12), PAPER)
    small, away = splats.radii.copy(), splats.means2d.copy()
    small[0], away[0] = 0, away[0] + 40.0
    assert flipped(scene, PAPER) is None
    assert flipped(scene, replace(PAPER, near_plane=float(splats.depths[0]) + 0.1)) == "D1"
    assert flipped(scene, PAPER, {"radii": small}) == "D2"
    assert flipped(scene, PAPER, {"means2d": away}) == "D3"
    assert flipped(scene, PAPER, {"depths": splats.depths[[1, 0, 2, 3]]}) == "D4"
    assert flipped(scene, PAPER, {"opacities": splats.opacities * [0.01, 1.0, 1.0, 1.0]}) == "D5"
    assert flipped(scene, replace(PAPER, alpha_ceiling=0.99)) == "D6"
    assert flipped(scene, replace(PAPER, transmittance_stop=1e-6)) == "D7"
    assert flipped(scene, PAPER, {"opacities": splats.opacities * [2.0, 1.0, 1.0, 1.0]}) == "D8"


def test_profiles_are_compared_over_the_view_and_the_oracle_over_the_tile(scene: ExplainedView) -> None:
    parting = difference(scene, "paper", "inria", 16, 12)
    inria, info = scene.rasterized(profile="inria")
    assert parting.region == (0, 0, VIEW.width, VIEW.height)
    assert parting.n_dominant == int((info["dominant_ids"] != scene.info["dominant_ids"]).sum())
    assert parting.largest == pytest.approx(float((inria - scene.image).abs().max()))
    assert parting.n_blended > 0
    # in a world that was made forty times larger Inria's near plane lies behind what this camera sees
    nothing = difference(scene, "inria", "paper", 16, 12, 40.0)
    assert nothing.flip is not None
    assert "is not between the planes 8 and" in " ".join(nothing.lines)
    assert parting.maps[0].picture.shape == (VIEW.height, VIEW.width, 3)
    exact = difference(scene, "fast", "ref", 16, 12)
    assert exact.region == (16, 0, 16, 16)
    assert exact.largest < 1e-4
    assert exact.flip is None
    with pytest.raises(PopError, match=r"neither a profile .* nor a backend"):
        difference(scene, "paper", "nonsense", 16, 12)


@pytest.fixture
def explain(pop: Pop, shared_result: Path) -> Callable[..., Outcome]:
    return lambda *words, view="3": pop("explain", shared_result, "--view", view, "--pixel", "20,16", *words)


def test_one_command_writes_table_json_page_and_maps(explain: Callable[..., Outcome], tmp_path: Path) -> None:
    files = {"--json": "why.json", "--html": "why.html", "--maps": "maps"}
    words = [word for flag, name in files.items() for word in (flag, tmp_path / name)]
    outcome = explain(*words, "--diff", "paper", "gsplat_1_6")
    assert "pixel (20, 16)" in outcome.out
    assert "paper | gsplat_1_6" in outcome.out
    plain = json.loads((tmp_path / "why.json").read_text())
    assert plain["difference"]["names"] == ["paper", "gsplat_1_6"]
    html = (tmp_path / "why.html").read_text()
    assert not re.search(r"""(src|href)=["'](?!data:)""", html)
    drawn = [row for row in plain["rows"] if row["status"] == "blended"]
    assert all(f'data-id="{row["id"]}"' in html for row in drawn)
    # the keyboard reaches the lines, too
    assert all(f'data-id="{row["id"]}" tabindex="0"' in html for row in drawn)
    assert html.count("<ellipse") == 4 * min(len(drawn), 14)
    assert all("aria-label=" in drawing for drawing in re.findall('<svg[^>]*role="img"[^>]*>', html))
    names = {path.stem for path in (tmp_path / "maps").iterdir()}
    assert {"dominant_ids", "n_blended", "n_traversed", "termination_depth", "T_final", "error", "pop_pull"} <= names
    assert {"importance", "importance_gaussians", "diff_color", "diff_dominant"} <= names
    pictures = sorted((tmp_path / "maps").glob("*.png"))
    assert all(cv2.imread(str(path)).shape == (32, 40, 3) for path in pictures)
    legend = json.loads((tmp_path / "maps" / "maps.json").read_text())
    assert sorted(legend) == [path.name for path in pictures]
    assert legend["pop_pull.png"]["scale"] == {"colors": "coolwarm", "low": -1.0, "top": 1.0}


def test_the_page_runs_its_own_script_and_no_other(explain: Callable[..., Outcome], tmp_path: Path) -> None:
    assert explain("--html", tmp_path / "why.html").status == 0
    html = (tmp_path / "why.html").read_text()
    assert html.index("Content-Security-Policy") < html.index("<title>")
    # as a name in a capture that was not escaped would do it
    smuggled = "<script>window.smuggled = 1</script><img src=x onerror='window.smuggled = 1'>"
    (tmp_path / "why.html").write_text(html.replace("<header>", f"<header>{smuggled}", 1))
    with browser(tmp_path / "browser") as tab:
        tab.open(tmp_path / "why.html", 1000, 800)
        tab.wait_for("document.readyState === 'complete'")
        tab.value("document.getElementById('all').click()")
        tab.wait_for("document.body.classList.contains('all')")
        assert tab.value("window.smuggled ?? 0") == 0
        assert tab.value("getComputedStyle(document.querySelector('.swatch')).backgroundColor").startswith("rgb")
        assert tab.value("document.querySelector('figure img').naturalWidth") > 0


def test_no_page_makes_html_of_text() -> None:
    scripts = sorted((Path(pop_fast.__file__).parent / "view").rglob("*.js"))
    assert len(scripts) >= 4
    for script in scripts:
        assert not re.search(r"innerHTML|outerHTML|AdjacentHTML|document\.write|eval\(", script.read_text()), script


def test_a_pixel_is_explained_in_every_profile_and_its_view_may_be_named(explain: Callable[..., Outcome]) -> None:
    for profile in PROFILES:
        assert f"profile {profile}" in explain("--profile", profile).out
    by_place = explain().out
    assert "view_003.png" in by_place
    assert [explain(view=name).out for name in ("view_003.png", "view_003")] == [by_place] * 2


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("--view 0 --pixel 40,3", "pixel x is 40; view view_000.png is 40 x 32 px, so x must lie in 0..39"),
        ("--view 0 --pixel 4,-1", "pixel y is -1;"),
        ("--view 0 --pixel four", "pixel is 'four'; give column and row"),
        ("--view 0", "pixel is not given; say which with --pixel X,Y"),
        ("--view 8 --pixel 1,1", "view is 8; toy has views 0 (view_000.png) to 7 (view_007.png)"),
        ("--view cat.jpg --pixel 1,1", "view 'cat.jpg' is no view of toy; give a file name"),
        ("--view 0 --pixel 1,1 --capture nowhere", "nowhere: no such folder"),
        ("--view 0 --pixel 1,1 --diff paper mine", "'mine', which is neither a profile"),
        ("--view 0 --pixel 1,1 --profile mine", "profile is 'mine'; it must be one of paper, gsplat_1_5"),
    ],
)
def test_bad_words_are_answered_by_one_line_that_names_field_and_fix(
    pop, shared_result, tmp_path, monkeypatch, words, part
):
    monkeypatch.chdir(tmp_path)
    says(pop("explain", shared_result, *words.split()), part)


# `pop explain` told which loss, which view and which two renderers: the words that choose are obeyed.

OPTIONS = {"2": ("3dgs", photometric_3dgs), "9": ("pop", photometric_pop)}


@pytest.mark.parametrize("equation", OPTIONS)
def test_an_objective_is_the_papers_whatever_the_run_was_trained_with(equation: str) -> None:
    name, loss = OPTIONS[equation]
    trained = TrainConfig.of(**MIXED, method="gsplat" if name == "pop" else "pop")
    view = explain_view(params(), VIEW, with_objective(trained, name))
    image = view.image.clone().requires_grad_(True)
    value = loss(image, torch.from_numpy(VIEW.image).double() / 255.0)
    (v_image,) = torch.autograd.grad(value, image)
    assert view.loss == pytest.approx(float(value.detach()), rel=1e-12)
    np.testing.assert_allclose(view.v_image, v_image, rtol=1e-9, atol=1e-18)
    assert (view.lambda_pop > 0.0) == (name == "pop")
    assert torch.any(view.v_pop != 0.0) == (name == "pop")
    e = explain_pixel(view, 16, 12)
    assert np.allclose(e.v_color, v_image[12, 16], rtol=1e-9, atol=1e-18)
    assert all((row.v_opacity_pop == 0.0) == (name == "3dgs") for row in e.blended)


def test_the_objective_of_the_command_line_changes_the_pull_and_not_the_picture(explain, tmp_path):
    told = {}
    for objective in ("run", "pop", "3dgs"):
        plain, page = (tmp_path / f"{objective}.{kind}" for kind in ("json", "html"))
        words = () if objective == "run" else ("--objective", objective)
        outcome = explain("--json", plain, "--html", page, *words)
        told[objective] = json.loads(plain.read_text())
        # nothing is said of a term that the objective has not, but that it has none
        said = outcome.out.partition("this objective has no POP term")
        assert (said[1] == "") == (objective != "3dgs")
        assert ("POP" in said[0]) == (objective != "3dgs")
        html = re.sub(
            r"<script>.*|<style>.*?</style>|[tT]his objective has no POP term", "", page.read_text(), flags=re.S
        )
        assert ("POP" in html) == (objective != "3dgs")
    # the run was trained with POP's objective
    assert told["run"] == told["pop"]
    assert told["3dgs"]["lambda_pop"] == 0.0
    assert told["3dgs"]["color"] == told["pop"]["color"]
    assert told["3dgs"]["v_color"] != told["pop"]["v_color"]
    assert {row["pop"] for row in told["3dgs"]["rows"]} == {"none"}
    assert {row["pop"] for row in told["pop"]["rows"]} <= {"up", "down"}


def test_a_name_that_two_views_bear_is_refused_and_a_number_may_be_a_name() -> None:
    capture = tiny_capture(n_views=3)
    names = ("left/a.png", "right/a.png", "0.png")
    capture = replace(capture, views=tuple(replace(v, name=n) for v, n in zip(capture.views, names, strict=True)))
    with pytest.raises(PopError, match=r"view 'a\.png' names 2 views of tiny; give a file name, or a place from 0"):
        chosen_view(capture, "a.png")
    for odd in ("²", "--1"):
        with pytest.raises(PopError, match="is no view of tiny"):
            chosen_view(capture, odd)
    assert chosen_view(capture, "right/a.png").name == "right/a.png"
    assert chosen_view(capture, "0").name == "0.png"
    # places go by file name
    assert chosen_view(capture, "2").name == "right/a.png"


@pytest.mark.skipif(cuda_ext.available(), reason="the CUDA backend can run here")
def test_without_a_gpu_one_sentence_says_why_and_what_to_do(explain: Callable[..., Outcome], tmp_path: Path) -> None:
    outcome = explain("--json", tmp_path / "why.json", "--diff", "fast", "cuda")
    says(outcome, "backend 'cuda' cannot run: ", str(cuda_ext.why_not()))
    # refused before anything is told or written
    assert outcome.out == ""
    assert not (tmp_path / "why.json").exists()


Change = Callable[[dict[str, Any]], dict[str, Any]]


@dataclass(frozen=True)
class Spoilt(TorchBackend):
    """Draws as pop_fast does, from arguments that it has spoilt."""

    change: Change = field(kw_only=True)

    def rasterization(self, **kwargs: Any) -> Any:
        return FAST.rasterization(**(kwargs | self.change(kwargs)))


@pytest.fixture
def instead_of_cuda(monkeypatch: pytest.MonkeyPatch) -> Callable[[Change], None]:
    """Put a backend that spoils its arguments in place of "cuda"."""

    def put(change: Change) -> None:
        spoilt = Spoilt("cuda", "cpu", FAST.dtypes, speed=None, change=change)
        monkeypatch.setitem(BACKENDS._loaded, "cuda", spoilt)

    return put


def fainter(gaussian: int, alpha: float, falloff: float) -> Change:
    """Give a Gaussian the opacity that makes its alpha what is asked for where its falloff is known."""

    def change(given: dict[str, Any]) -> dict[str, Any]:
        opacities = given["opacities"].clone()
        opacities[gaussian] = alpha / falloff
        return {"opacities": opacities}

    return change


def test_a_backend_that_skips_a_splat_is_shown_with_the_decision_that_flipped(scene, instead_of_cuda):
    row, floor = explain_pixel(scene, 16, 12).blended[1], PAPER.alpha_floor
    instead_of_cuda(fainter(row.id, 0.999 * floor, row.falloff))
    found = difference(scene, "fast", "cuda", 16, 12)
    assert (found.names, found.at) == (("fast", "cuda"), (16, 12))
    assert found.region == (0, 0, VIEW.width, VIEW.height)
    assert (found.flip.decision, found.flip.gaussian) == ("D5", row.id)
    assert found.flip.first.startswith("blends it: alpha ")
    assert re.fullmatch(rf"skips it: alpha 0\.0039\d+, floor {floor:.9f}", found.flip.second)
    assert found.n_blended > 0
    assert found.largest > 0.0


def test_a_backend_with_another_ceiling_parts_by_d6_and_the_worst_pixel_is_looked_up(scene, instead_of_cuda):
    instead_of_cuda(lambda given: {"profile": "gsplat_1_6"})
    image, info = scene.rasterized(torch.float32, get_backend("cuda"))
    sound, own = scene.rasterized(torch.float32, get_backend("fast"))
    differs = (image - sound).abs().amax(dim=2) + (info["n_contrib"] != own["n_contrib"])[0]
    x, y = next((x, y) for x, y in PIXELS if differs[y, x] == 0.0)
    found = difference(scene, "fast", "cuda", x, y)
    assert found.at != (x, y)
    assert differs[found.at[1], found.at[0]] > 0.0
    assert f"at pixel ({x}, {y}):" in found.lines
    assert f"at pixel ({found.at[0]}, {found.at[1]}):" in found.lines
    assert found.n_colors == int(((image - sound).abs().amax(dim=2) > 1.0 / 255.0).sum())


def test_the_command_line_shows_where_two_backends_part(explain, tmp_path, instead_of_cuda):
    assert explain("--json", tmp_path / "own.json").status == 0
    rows = json.loads((tmp_path / "own.json").read_text())["rows"]
    # away from its centre a splat may be too faint at the pixel and still be visible elsewhere
    row = next(row for row in rows if row["status"] == "blended" and row["falloff"] < 0.5)
    instead_of_cuda(fainter(row["id"], 0.99 * PAPER.alpha_floor, row["falloff"]))
    outcome = explain("--json", tmp_path / "why.json", "--diff", "fast", "cuda")
    assert f"D5 is the first decision that differs, at Gaussian {row['id']}" in outcome.out
    assert "fast | cuda, 40 x 32 px from (0, 0):" in outcome.out
    flip = json.loads((tmp_path / "why.json").read_text())["difference"]["flip"]
    assert (flip["decision"], flip["gaussian"]) == ("D5", row["id"])
    assert "skips it" in flip["second"]
