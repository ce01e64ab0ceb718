"""The rows' files: whole, in agreement with the recipes and with paper.toml, and refused where they are wrong."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import pytest

from paper_repro import jobs, scenes
from paper_repro.jobs import (
    CONFIGS,
    ROWS,
    NotTrainableError,
    header_of,
    job_named,
    jobs_of,
    load_row,
    load_rows,
    missing_method,
)
from paper_repro.paper import paper
from paper_repro.scenes import SCALES, SCENES
from pop_fast.errors import PopError
from pop_ref.constants import PROFILES
from pop_ref.recipes import BASELINES, L1_DIVIDED, RECIPES, Recipe
from pop_ref.settings import DensityConfig, PopTerm

# rows that are a recipe of the oracle
OF_RECIPES = {
    "pop": "POP",
    "l2": "L2",
    "l2_blur": "L2+Blur",
    "l2_pop": "L2+POP",
    "reset": "Reset",
    "3dgs": "3DGS",
    "gsplat": "gsplat",
}
NAMED: dict[str, Recipe] = {
    **{row: RECIPES[name] for row, name in OF_RECIPES.items()},
    "3dgs_2023": RECIPES["3DGS 2023"],
    **{f"l1_div_{n}": recipe for n, recipe in L1_DIVIDED.items()},
    **{
        f"blur_3k_{end}k": replace(RECIPES["POP"], density=replace(RECIPES["POP"].density, blur_stop_iter=1000 * end))
        for end in (4, 11, 15)
    },
}
# rows of other methods, whose own steps of density control are their strategies'
OTHERS: dict[str, Recipe] = {
    "pup": BASELINES["PUP-3DGS"],
    "mini_splatting": BASELINES["Mini-Splatting"],
    "taming": BASELINES["Taming-3DGS"],
    "speedy_splat": BASELINES["Speedy-Splat"],
}
# rows that read an open question otherwise, with the one value in which they differ from POP
READINGS = {
    "pop_visible": ("pop_over", "visible"),
    "pop_any_view": ("blur_window", "any_view"),
    "pop_prune_002": ("prune_opa", 0.02),
    "pop_sum": ("blur_window", "sum"),
    "pop_size_prune": ("prune_too_big", True),
}


def test_every_file_is_a_row_and_every_row_has_a_file():
    assert sorted(path.stem for path in CONFIGS.glob("*.toml")) == sorted(ROWS)
    assert len(set(ROWS)) == len(ROWS)


@pytest.mark.parametrize("name", ROWS)
def test_a_file_opens_with_claim_hardware_and_hours_and_describes_its_row(name):
    header = header_of(name)
    assert set(header) >= {"claim", "hardware", "hours"}
    row = load_row(name)
    lines = row.description.splitlines()
    assert 3 <= len(lines) <= 12
    assert any(line.startswith("Sources: ") for line in lines)


def test_rows_have_the_names_and_bytes_that_the_paper_has_for_them():
    printed = {}
    for table in paper().tables:
        for line in table.rows:
            printed.setdefault(line.row, {})[str(table.number)] = line.name
    for row in load_rows():
        assert dict(row.paper) == printed.get(row.name, {}), row.name
        assert [str(number) for number in row.tables] == list(row.paper), row.name
        assert row.bytes_per_gaussian == paper().bytes_per_gaussian.get(row.name, row.bytes_per_gaussian), row.name


@pytest.mark.parametrize("name", [*NAMED, *OTHERS])
def test_a_row_trains_what_the_recipe_of_its_name_says(name):
    recipe, config = {**NAMED, **OTHERS}[name], job_named(name, "garden", "paper").config()
    for kind, said in ((DensityConfig, recipe.density), (PopTerm, recipe)):
        for field in fields(kind):
            assert getattr(config.strategy, field.name) == getattr(said, field.name), field.name
    photometric = (config.photometric, config.lambda_ssim, config.l2_stop_iter, config.ssim_padding)
    assert photometric == (recipe.pixelwise, recipe.lambda_ssim, recipe.l2_stop_iter, recipe.padding)
    assert config.photometric_divisor == pytest.approx(1.0 / recipe.pixel_scale, rel=1e-15)
    assert (config.lr, PROFILES[config.profile]) == (recipe.lr, recipe.profile)
    assert (config.max_steps, config.sh_interval) == (recipe.max_steps, recipe.sh_interval)


@pytest.mark.parametrize("name", READINGS)
def test_a_reading_differs_from_pop_in_one_value(name):
    pop = job_named("pop", "garden", "paper").config().strategy
    assert replace(pop, **dict([READINGS[name]])) == job_named(name, "garden", "paper").config().strategy != pop


def test_no_two_rows_train_the_same():
    words = [tuple(job_named(name, "train", "paper").words()) for name in ROWS]
    assert len(set(words)) == len(ROWS)


def test_step_numbers_of_options_are_shortened_with_the_schedule():
    blur = job_named("blur_3k_4k", "demo", "toy").config().strategy
    assert (blur.blur_start_iter, blur.blur_stop_iter, blur.refine_stop_iter) == (30, 40, 150)
    # a share, a weight and a factor are no step numbers
    l1 = job_named("l1_div_5", "demo", "toy").config()
    assert (l1.photometric_divisor, l1.max_steps, l1.strategy.lambda_pop) == (5.0, 300, 0.0)
    # never stays never
    assert job_named("l2", "demo", "toy").config().strategy.blur_stop_iter == -1
    reset, pop = (job_named(row, "demo", "toy").config().strategy for row in ("reset", "pop"))
    assert (reset.reset_every, reset.prune_too_big_after, reset.prune_too_big) == (30, 30, True)
    assert (pop.reset_every, pop.prune_too_big) == (0, False)


@pytest.mark.parametrize("scale", ["small", "no_floor", "full", "paper"])
def test_the_scales_that_judge_have_the_whole_schedule(scale):
    scene = next(iter(SCALES[scale].factors))
    reset, whole = job_named("reset", scene, scale).config(), job_named("reset", "garden", "paper").config()
    assert SCALES[scale].steps_scaler == 1.0
    assert replace(reset.strategy, blur_min_pixels=0.0) == whole.strategy
    assert (reset.max_steps, reset.sh_interval) == (whole.max_steps, whole.sh_interval)


def test_a_small_scale_keeps_theta_blur_at_ten_pixels_and_the_papers_does_not():
    for scale, floor in (("toy", 10.0), ("small", 10.0), ("full", 10.0), ("no_floor", 0.0), ("paper", 0.0)):
        scene = next(iter(SCALES[scale].factors))
        assert job_named("pop", scene, scale).config().strategy.blur_min_pixels == floor


@pytest.mark.parametrize("scale", ["toy", "small", "full"])
def test_a_small_scale_sets_fewer_points_anew_than_its_views_have_pixels(scale):
    for scene, factor in SCALES[scale].factors.items():
        (width, height), views = SCENES[scene].size, SCENES[scene].n_images
        points = job_named("mini_splatting", scene, scale).config().strategy.reinit_points
        assert 0.005 < points / (width * height // factor**2 * views) < 0.05
    assert job_named("mini_splatting", "garden", "paper").config().strategy.reinit_points == 3_500_000


def test_rows_of_a_method_that_is_not_there_say_so(monkeypatch):
    from pop_fast.train import presets

    without = {name: method for name, method in presets.METHODS.items() if name != "gsplat"}
    monkeypatch.setattr(presets, "METHODS", without)
    assert "no method 'gsplat'" in str(missing_method(load_row("gsplat")))
    with pytest.raises(NotTrainableError, match="row gsplat: this version of pop has no method 'gsplat'; it has pop"):
        job_named("gsplat", "fox", "small").config()


def test_rows_of_an_option_that_is_not_there_say_so(capsys):
    job = job_named("pop", "fox", "small")
    strange = replace(job, row=replace(job.row, options=("--pop.wings", "2")))
    with pytest.raises(NotTrainableError, match=r"row pop: this version of pop train does not take .*--pop\.wings 2"):
        strange.config()
    assert capsys.readouterr() == ("", "")


def test_options_of_a_scene_come_after_those_of_its_dataset():
    row = replace(load_row("pop"), options=("a",), scenes={"mipnerf360": ("b",), "garden": ("c",), "db": ("d",)})
    assert row.options_for(SCENES["garden"]) == ("a", "b", "c")
    assert row.options_for(SCENES["bicycle"]) == ("a", "b")
    assert row.options_for(SCENES["truck"]) == ("a",)


@pytest.mark.parametrize("name", ["mini_splatting", "mini_splatting_star", "taming"])
def test_rows_with_options_by_scene_have_them_for_every_scene(name):
    row = load_row(name)
    said = {scene.name: row.options_for(scene)[len(row.options) :] for scene in SCENES.values()}
    assert all(said.values()), [scene for scene, words in said.items() if not words]
    assert len(set(said.values())) > 1


def test_inrias_rasterizer_draws_no_scene_whose_principal_point_lies_far_off():
    profiles = {
        (row, scene): job_named(row, scene, "small").config().profile
        for row in ("pop", "3dgs", "speedy_splat")
        for scene in ("fox", "bear_512")
    }
    assert profiles == {
        ("pop", "fox"): "paper",
        ("pop", "bear_512"): "paper",
        ("3dgs", "fox"): "inria",
        ("3dgs", "bear_512"): "gsplat_1_5",
        ("speedy_splat", "fox"): "speedy_splat",
        ("speedy_splat", "bear_512"): "gsplat_1_5",
    }


def test_jobs_come_cheapest_first_and_names_are_checked():
    jobs = jobs_of("small", seeds=(42, 43))
    assert [job.cost for job in jobs] == sorted(job.cost for job in jobs)
    assert len(jobs) == len(set(map(str, jobs))) == 2 * len(ROWS) * len(SCALES["small"].factors)
    small, large = (job_named("pop", scene, "small").cost for scene in ("bear_512", "fox"))
    assert small < large < job_named("pop", "bonsai_800", "full").cost
    with pytest.raises(PopError, match="row is 'pops'; it must be one of 3dgs, "):
        job_named("pops", "fox", "small")
    with pytest.raises(PopError, match="scene is 'foxes'; it must be one of "):
        job_named("pop", "foxes", "small")
    with pytest.raises(PopError, match="scale 'small' has no garden; its scenes are fox, "):
        job_named("pop", "garden", "small")
    with pytest.raises(PopError, match="scale is 'tiny'; it must be one of toy, shown, small, no_floor, full, paper"):
        job_named("pop", "fox", "tiny")


WRONG = {
    "title = 3": "title is 3; it must be a text",
    'options = "--seed 3"': "options is '--seed 3'; it must be a list of texts",
    'tables = ["1"]': r"tables is \['1'\]; it must be a list of whole numbers",
    "cost = 0": "cost is 0; it must be a number above 0",
    "bytes_per_gaussian = 240": "bytes_per_gaussian is 240; it must be 236 or 248",
    'method = "pop"\nwings = 2': "wings is not a field of a row",
    'method = "pop"\nbase = "paup"': "base is 'paup'; it must be one of 3dgs",
    'description = ""': "description is ''; it must be a text",
}


@pytest.mark.parametrize("line", WRONG)
def test_a_wrong_field_is_named(tmp_path: Path, line):
    whole = (jobs.CONFIGS / "pop.toml").read_text()
    field = line.split(" = ")[0]
    text = "\n".join(line if found.startswith(f"{field} =") else found for found in whole.splitlines())
    if field == "description":
        head, _, rest = whole.partition('description = """')
        text = head + line + rest.partition('"""')[2]
    (tmp_path / "pop.toml").write_text(text)
    with pytest.raises(PopError, match=WRONG[line]):
        load_row("pop", tmp_path)


def test_a_missing_field_a_strange_scene_and_what_is_no_toml_are_named(tmp_path: Path):
    whole = (jobs.CONFIGS / "pop.toml").read_text()
    (tmp_path / "pop.toml").write_text(whole.replace('method = "pop"\n', ""))
    with pytest.raises(PopError, match=r"pop\.toml: has no method"):
        load_row("pop", tmp_path)
    (tmp_path / "pop.toml").write_text(whole + "\n[scenes]\nmoon = []\n")
    with pytest.raises(PopError, match=r"scenes\.moon is neither a dataset nor a scene"):
        load_row("pop", tmp_path)
    (tmp_path / "pop.toml").write_text(whole.replace("[paper]", "[paper"))
    with pytest.raises(PopError, match=r"pop\.toml: is not TOML: "):
        load_row("pop", tmp_path)
    (tmp_path / "pop.toml").write_text(whole.split("\n\n", 1)[1])
    with pytest.raises(PopError, match="its first lines must be '# Claim"):
        header_of("pop", tmp_path)


def test_the_scenes_of_the_papers_scale_are_the_papers():
    of_paper = {scene.name for scene in scenes.SCENES.values() if scene.in_paper}
    assert {scene for names in paper().datasets.values() for scene in names} == of_paper == set(SCALES["paper"].factors)
