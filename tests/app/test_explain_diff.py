"""`pop explain` told which loss, which view and which two renderers: the words that choose are obeyed."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import cuda_ext
from pop_fast.api.registry import BACKENDS, get_backend
from pop_fast.cli.explain import chosen_view
from pop_fast.errors import PopError
from pop_fast.stages.backend import FAST, TorchBackend
from pop_fast.stages.losses import photometric_3dgs, photometric_pop
from pop_fast.train.config import TrainConfig
from pop_fast.view.explain import ExplainedView, explain_pixel, explain_view
from pop_fast.view.explain.diff import difference
from pop_fast.view.explain.scene import with_objective
from pop_ref.constants import PAPER
from tests.app.conftest import Pop
from tests.app.damage import says
from tests.app.test_explain import MIXED, PIXELS, VIEW, params
from tests.app.tiny import tiny_capture

OPTIONS = {"2": ("3dgs", photometric_3dgs), "9": ("pop", photometric_pop)}


@pytest.fixture(scope="module")
def scene() -> ExplainedView:
    """The made-up splat in one view, over a background that is not black."""
    return explain_view(params(), VIEW, TrainConfig(**MIXED))


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


def test_the_objective_of_the_command_line_changes_the_pull_and_not_the_picture(
    pop: Pop, shared_result: Path, tmp_path: Path
) -> None:
    told = {}
    for objective in ("run", "pop", "3dgs"):
        files = ("--json", tmp_path / f"{objective}.json", "--html", tmp_path / f"{objective}.html")
        words = ("explain", shared_result, "--view", "3", "--pixel", "20,16", *files)
        outcome = pop(*words, *(() if objective == "run" else ("--objective", objective)))
        assert outcome.status == 0, outcome.err
        told[objective] = json.loads((tmp_path / f"{objective}.json").read_text())
        # nothing is said of a term that the objective has not, but that it has none
        said = outcome.out.partition("this objective has no POP term")
        assert (said[1] == "") == (objective != "3dgs")
        assert ("POP" in said[0]) == (objective != "3dgs")
        page = re.sub(r"<script>.*|<style>.*?</style>", "", (tmp_path / f"{objective}.html").read_text(), flags=re.S)
        page = page.replace("this objective has no POP term", "").replace("This objective has no POP term", "")
        assert ("POP" in page) == (objective != "3dgs")
    # the run was trained with POP's objective
    assert told["run"] == told["pop"]
    assert told["3dgs"]["lambda_pop"] == 0.0
    assert told["3dgs"]["color"] == told["pop"]["color"]
    assert told["3dgs"]["v_color"] != told["pop"]["v_color"]
    assert {row["pop"] for row in told["3dgs"]["rows"]} == {"none"}
    assert {row["pop"] for row in told["pop"]["rows"]} <= {"up", "down"}


@pytest.mark.parametrize("name", ["view_003.png", "view_003"])
def test_a_view_may_be_named(pop: Pop, shared_result: Path, name: str) -> None:
    by_place = pop("explain", shared_result, "--view", "3", "--pixel", "20,16")
    by_name = pop("explain", shared_result, "--view", name, "--pixel", "20,16")
    assert by_name.status == 0, by_name.err
    assert "view_003.png" in by_name.out
    assert by_name.out == by_place.out


def test_a_name_that_two_views_bear_is_refused_and_a_number_may_be_a_name() -> None:
    capture = tiny_capture(n_views=3)
    names = ("left/a.png", "right/a.png", "0.png")
    capture = replace(capture, views=tuple(replace(v, name=n) for v, n in zip(capture.views, names, strict=True)))
    with pytest.raises(PopError, match=r"view 'a\.png' names 2 views of tiny; give a file name, or a place from 0"):
        chosen_view(capture, "a.png")
    assert chosen_view(capture, "right/a.png").name == "right/a.png"
    assert chosen_view(capture, "0").name == "0.png"
    # places go by file name
    assert chosen_view(capture, "2").name == "right/a.png"


@pytest.mark.skipif(cuda_ext.available(), reason="the CUDA backend can run here")
def test_without_a_gpu_one_sentence_says_why_and_what_to_do(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    words = ("--view", "3", "--pixel", "20,16", "--json", tmp_path / "why.json", "--diff", "fast", "cuda")
    outcome = pop("explain", shared_result, *words)
    reason = cuda_ext.why_not()
    assert reason is not None
    says(outcome, "backend 'cuda' cannot run: ", reason)
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


def fainter(gaussian: int, alpha: float, falloff: float) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Give a Gaussian the opacity that makes its alpha what is asked for where its falloff is known."""

    def change(given: dict[str, Any]) -> dict[str, Any]:
        opacities = given["opacities"].clone()
        opacities[gaussian] = alpha / falloff
        return {"opacities": opacities}

    return change


def test_a_backend_that_skips_a_splat_is_shown_with_the_decision_that_flipped(
    scene: ExplainedView, instead_of_cuda: Callable[[Change], None]
) -> None:
    x, y = 16, 12
    row = explain_pixel(scene, x, y).blended[1]
    floor = PAPER.alpha_floor
    instead_of_cuda(fainter(row.id, 0.999 * floor, row.falloff))
    found = difference(scene, "fast", "cuda", x, y)
    assert found.names == ("fast", "cuda")
    assert found.at == (x, y)
    assert found.region == (0, 0, VIEW.width, VIEW.height)
    assert found.flip is not None
    assert (found.flip.decision, found.flip.gaussian) == ("D5", row.id)
    assert found.flip.first.startswith("blends it: alpha ")
    assert re.fullmatch(rf"skips it: alpha 0\.0039\d+, floor {floor:.9f}", found.flip.second)
    assert found.n_blended > 0
    assert found.largest > 0.0


def test_a_backend_with_another_ceiling_parts_by_d6_and_the_worst_pixel_is_looked_up(
    scene: ExplainedView, instead_of_cuda: Callable[[Change], None]
) -> None:
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


def test_the_command_line_shows_where_two_backends_part(
    pop: Pop, shared_result: Path, tmp_path: Path, instead_of_cuda: Callable[[Change], None]
) -> None:
    words = ("explain", shared_result, "--view", "3", "--pixel", "20,16")
    assert pop(*words, "--json", tmp_path / "own.json").status == 0
    rows = json.loads((tmp_path / "own.json").read_text())["rows"]
    # away from its centre a splat may be too faint at the pixel and still be visible elsewhere
    row = next(row for row in rows if row["status"] == "blended" and row["falloff"] < 0.5)
    faint = fainter(row["id"], 0.99 * PAPER.alpha_floor, row["falloff"])
    instead_of_cuda(faint)
    outcome = pop(*words, "--json", tmp_path / "why.json", "--diff", "fast", "cuda")
    assert outcome.status == 0, outcome.err
    assert f"D5 falls otherwise first, at Gaussian {row['id']}" in outcome.out
    assert "fast | cuda, 40 x 32 px from (0, 0):" in outcome.out
    flip = json.loads((tmp_path / "why.json").read_text())["difference"]["flip"]
    assert flip["decision"] == "D5"
    assert flip["gaussian"] == row["id"]
    assert "skips it" in flip["second"]
