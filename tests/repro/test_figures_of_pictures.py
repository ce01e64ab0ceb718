"""Figures 3 and 5: renders beside photographs, the place where they differ, and the gradients that losses see."""

from __future__ import annotations

import csv
import shutil
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from paper_repro.figures import artifact, qualitative, style
from paper_repro.figures.data import NoDataError
from paper_repro.figures.style import save
from paper_repro.jobs import job_named
from paper_repro.results import RESULTS
from paper_repro.train_row import Options, capture_folder, load_capture_of
from pop_fast.errors import PopError
from tests.repro.made import asked, lines, result, texts


def keep(folder: Path, row: str, scene: str, render: np.ndarray, photo: np.ndarray, psnr: float) -> None:
    """Leave what a run keeps of its first held-out view."""
    kept = folder / "small" / row / f"{scene}_42" / "report_data"
    kept.mkdir(parents=True)
    np.savez(kept / "val_step9999_0000.npz", name="0001.jpg", render=render, photo=photo, psnr=psnr, ssim=0.9)


@pytest.fixture
def renders(tmp_path):
    """Two scenes with the renders of both rows, which differ in one place each."""
    generator, places = np.random.default_rng(1), {"fox": (30, 50), "bear_512": (5, 2)}
    for scene, (x, y) in places.items():
        height, width = (80, 45) if scene == "fox" else (40, 60)
        photo = generator.integers(0, 200, (height, width, 3), dtype=np.uint8)
        other = photo.copy()
        other[y : y + 10, x : x + 10] += 40
        keep(tmp_path, "pop", scene, photo, photo, 30.0)
        keep(tmp_path, "3dgs", scene, other, photo, 20.5)
    return tmp_path, places


def test_the_grid_of_renders_boxes_the_place_where_they_differ(renders):
    folder, places = renders
    runs = [result(row, scene) for row in ("pop", "3dgs") for scene in places]
    with style.look():
        made = qualitative.renders_and_photographs(asked("5", runs, folder))
        paths = save(made, folder / "figure_5")
    ET.parse(paths[0])
    for line in lines(made):
        # the whole of the place is in the box
        for inside, corner in zip(places[line["scene"]], (line["box_x"], line["box_y"]), strict=True):
            assert 0 <= inside - corner <= line["box_side"] - 10
        assert line["psnr"] == (30.0 if line["row"] == "pop" else 20.5)
    said = texts(made).replace("\n", " ")
    assert "30.00 dB" in said
    assert "Not every row was run on garden_512 and bonsai_800." in said


def test_a_scene_that_was_trained_elsewhere_is_not_said_not_to_be_run(renders):
    folder, places = renders
    shutil.rmtree(folder / "small" / "pop" / "bear_512_42")
    runs = [result(row, scene) for row in ("pop", "3dgs") for scene in places]
    with style.look():
        said = texts(qualitative.renders_and_photographs(asked("5", runs, folder))).replace("\n", " ")
    assert "The work folder has no renders of bear_512." in said
    assert "Not every row was run on garden_512 and bonsai_800." in said


def test_the_grid_in_the_repository_is_of_the_still_life_and_worth_showing():
    with (RESULTS / "shown" / "figures" / "figure_5.csv").open(encoding="utf-8", newline="") as file:
        found = list(csv.DictReader(file))
    assert [(line["scene"], line["row"]) for line in found] == [("still_life", "pop"), ("still_life", "3dgs")]
    assert all(float(line["psnr"]) > 25.0 for line in found)


def test_without_renders_the_grid_says_where_it_looked(tmp_path):
    runs = [result("pop"), result("3dgs")]
    with pytest.raises(NoDataError, match=f"whose renders are in {tmp_path}; give the folder"):
        qualitative.renders_and_photographs(asked("5", runs, tmp_path))


def test_the_most_different_square_is_that_of_a_search_over_all():
    generator = np.random.default_rng(2)
    for _ in range(10):
        one, other = generator.integers(0, 256, (2, 9, 13, 3), dtype=np.uint8)
        squares = ((one.astype(int) - other.astype(int)) ** 2).sum(axis=2)
        places = [(y, x) for y in range(9 - 4 + 1) for x in range(13 - 4 + 1)]
        y, x = max(places, key=lambda p: squares[p[0] : p[0] + 4, p[1] : p[1] + 4].sum())
        assert qualitative.most_different(one, other, 4) == (x, y)


@pytest.fixture(scope="module")
def artifacts(tmp_path_factory):
    """Figure 3 of a few steps from the demo capture's first Gaussians instead of a finished run's."""
    from pop_fast.data import initialize_params
    from pop_fast.io.ply import save_ply

    folder = tmp_path_factory.mktemp("artifact")
    how = Options(data=folder, work=folder)
    job = job_named("3dgs", "demo", "toy")
    config = job.config(data=str(capture_folder(job.scene, how)), result_dir=str(folder / "none"))
    params = initialize_params(load_capture_of(job, config)[0], 0)
    save_ply(job.work(folder) / "ply" / "point_cloud_299.ply", params)
    base = result("3dgs", "demo", scale="toy", schedule={"max_steps": 300})
    with pytest.MonkeyPatch.context() as patch, style.look():
        patch.setattr(artifact, "STEPS", 12)
        toy = asked("3", [base], folder, scale="toy")
        first = artifact.pushed(toy)
        patch.setattr(artifact, "_train", lambda *_: pytest.fail("trained again"))
        made = artifact.six_panels(toy)
        return params, first, made, save(made, folder / "figure_3")


def test_the_run_behind_the_artifacts_raises_every_opacity(artifacts):
    params, found, *_ = artifacts
    before = 1.0 / (1.0 + np.exp(-params["opacities"].numpy()))
    assert len(before) == len(found.opacities)
    assert float((found.opacities.numpy() > before).mean()) > 0.99


def test_the_six_panels_have_the_gradients_of_their_losses(artifacts):
    _, found, made, paths = artifacts
    ET.parse(paths[0])
    panels = {panel.key: panel for panel in artifact.panels_of(found)}
    error = np.abs(found.image.numpy().astype(float) - found.photo.numpy()).mean(axis=2)
    np.testing.assert_allclose(panels["error"].values, error, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(panels["grad_l2"].values, 2.0 * error, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(panels["grad_l1"].values[error > 1e-3].max(), 1.0, rtol=1e-5)
    assert panels["grad_l2"].correlation == pytest.approx(1.0, abs=1e-6)
    assert panels["grad_l1"].correlation is None or abs(panels["grad_l1"].correlation) < 0.2
    r = np.corrcoef(panels["grad_ssim"].values.ravel().astype(float), error.ravel())[0, 1]
    assert panels["grad_ssim"].correlation == pytest.approx(r, rel=1e-4)
    told = {line["quantity"]: line for line in lines(made)}
    assert told["grad_ssim"]["mean"] == pytest.approx(float(panels["grad_ssim"].values.mean()), rel=1e-6)
    assert "not the paper's protocol" in texts(made).replace("\n", " ")


def test_a_constant_map_has_no_correlation():
    ramp = np.arange(12.0).reshape(3, 4)
    assert artifact.correlation(np.full((3, 4), 0.3), ramp) is None
    assert artifact.correlation(ramp, -2.0 * ramp + 1.0) == pytest.approx(-1.0, rel=1e-12)


def test_the_artifacts_need_a_scene(tmp_path):
    with pytest.raises(PopError, match=f"{tmp_path} has none of kitchen; name another --data"):
        artifact.pushed(asked("3", [], tmp_path, scale="paper"))
