"""Rows, scenes and methods: whole, in agreement with the recipes and with paper.toml, and refused where they are wrong.

Scenes under a data root are found in their published layouts and checked. Every method is what its table says: what a
run resolves, on which schedule, and what happens in a step.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from paper_repro import jobs, scenes
from paper_repro.data_check import HOLD_OUT, check_capture, check_scene, table
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
from paper_repro.methods import FOLDER, load_pinned
from paper_repro.paper import paper
from paper_repro.scenes import (
    DATASETS,
    MADE,
    SCALES,
    SCENES,
    PaperScene,
    find_folder,
    load_scenes,
    scene_named,
    source_of,
)
from paper_repro.tables import beyond_rows
from pop_fast.cli.train import arguments
from pop_fast.data import load_capture
from pop_fast.demo import make_demo
from pop_fast.density import rows as edits
from pop_fast.errors import PopError
from pop_fast.io.images import read_image, write_png
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.model import KEYS
from pop_fast.train.presets import METHODS
from pop_ref.recipes import BASELINES, L1_DIVIDED, RECIPES, Recipe
from tests.app.test_config import assert_trains
from tests.app.test_strategies import tiny_method
from tests.app.tiny import skip_without, tiny_capture

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


def test_a_new_file_is_a_row_after_those_of_the_tables_and_stands_in_the_table_of_what_goes_beyond(
    tmp_path, monkeypatch
):
    (tmp_path / "zoned.toml").write_text((CONFIGS / "pop_prune_002.toml").read_text().replace("0.02", "0.03"))
    rows = jobs.own_rows(tmp_path)
    assert list(rows) == [*ROWS, "zoned"]
    monkeypatch.setitem(ROWS._given, "zoned", rows["zoned"])
    assert job_named("zoned", "demo", "toy").config().strategy.prune_opa == 0.03
    assert list(beyond_rows().items())[-1] == ("zoned", load_row("zoned").title)


def test_every_file_is_a_row_and_every_row_has_a_file():
    assert sorted(path.stem for path in CONFIGS.glob("*.toml")) == sorted(ROWS)
    assert len(set(ROWS)) == len(ROWS)
    # and no two train the same
    assert len({tuple(job_named(name, "train", "paper").words()) for name in ROWS}) == len(ROWS)


@pytest.mark.parametrize("name", ROWS)
def test_a_file_opens_with_claim_hardware_and_hours_and_describes_its_row(name):
    header = header_of(name)
    assert set(header) >= {"claim", "hardware", "hours"}
    # those of the data set on which the row takes the longest
    lines = [line for table in paper().tables for line in table.rows if line.row == name]
    seconds = [of["time_s"] for line in lines for of in line.values.values() if "time_s" in of]
    assert not seconds or header["hours"].startswith(f"{max(seconds) / 3_600:.2f} a scene in the paper; ")
    row = load_row(name)
    lines = row.description.splitlines()
    assert 3 <= len(lines) <= 12
    assert any(line.startswith("Sources: ") for line in lines)


def test_rows_have_the_names_and_bytes_that_the_paper_has_for_them():
    printed = {}
    for each in paper().tables:
        for line in each.rows:
            printed.setdefault(line.row, {})[str(each.number)] = line.name
    for row in load_rows():
        assert dict(row.paper) == printed.get(row.name, {}), row.name
        assert [str(number) for number in row.tables] == list(row.paper), row.name
        assert row.bytes_per_gaussian == paper().bytes_per_gaussian.get(row.name, row.bytes_per_gaussian), row.name


@pytest.mark.parametrize("name", [*NAMED, *OTHERS])
def test_a_row_trains_what_the_recipe_of_its_name_says(name):
    assert_trains(job_named(name, "garden", "paper").config(), {**NAMED, **OTHERS}[name])


@pytest.mark.parametrize("name", READINGS)
def test_a_reading_differs_from_pop_in_one_value(name):
    pop = job_named("pop", "garden", "paper").config().strategy
    assert replace(pop, **dict([READINGS[name]])) == job_named(name, "garden", "paper").config().strategy != pop


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
    assert (pop.reset_every, pop.prune_too_big, pop.blur_min_pixels) == (0, False, 10.0)


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


LAYOUTS = {
    "garden": ("mipnerf360/garden", "360_v2/garden", "garden"),
    "flowers": ("360_extra_scenes/flowers", "mipnerf360/flowers"),
    "train": ("tandt/train", "tandt_db/tandt/train"),
    "playroom": ("db/playroom", "tandt_db/db/playroom"),
    "fox": ("fox",),
    "bonsai_800": ("m360_bonsai_800",),
}
VIEWS, WIDTH, HEIGHT = 10, 48, 32


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A capture whose photographs lie in `images`, and half as large in `images_2`, as Mip-NeRF 360 has them."""
    folder = make_demo(tmp_path_factory.mktemp("made") / "bonsai", views=VIEWS, width=WIDTH, height=HEIGHT)
    for photograph in sorted((folder / "images").iterdir()):
        write_png(folder / "images_2" / photograph.name, read_image(photograph)[::2, ::2].copy())
    return folder


@pytest.fixture
def root(made, tmp_path, monkeypatch):
    """A data root with that capture as the scene "bonsai", published with these numbers."""
    shutil.copytree(made, tmp_path / "360_v2" / "bonsai")
    published = replace(SCENES["bonsai"], n_images=VIEWS, size=(WIDTH // 2, HEIGHT // 2))
    monkeypatch.setitem(scenes.SCENES, "bonsai", published)
    return tmp_path


def bonsai() -> PaperScene:
    return scene_named("bonsai")


@pytest.mark.parametrize(("name", "place"), [(name, place) for name in LAYOUTS for place in LAYOUTS[name]])
def test_a_scene_is_found_in_each_published_layout(tmp_path: Path, name, place):
    with pytest.raises(PopError, match=rf"has no {name} \(looked for .*\); it comes from http"):
        find_folder(SCENES[name], tmp_path)
    (tmp_path / place).mkdir(parents=True)
    assert find_folder(SCENES[name], tmp_path) == tmp_path / place
    with pytest.raises(PopError, match=r"nowhere: no such folder; name the one that holds the scenes with --data"):
        find_folder(SCENES[name], tmp_path / "nowhere")


def test_every_scene_says_what_it_is_and_where_it_comes_from():
    for scene in SCENES.values():
        assert source_of(scene)
        assert scene.in_paper != (scene.dataset == "further"), scene.name
        assert scene.note or scene.in_paper, f"{scene.name} must be labelled as what it is"
        assert scene.dataset in DATASETS
    assert [scene.name for scene in SCENES.values() if scene.images == "images_4"] == [
        *("bicycle", "flowers", "garden", "stump", "treehill")
    ]
    assert {scene for scale in SCALES.values() for scene in scale.factors} == set(SCENES)
    of_paper = {scene.name for scene in SCENES.values() if scene.in_paper}
    assert {scene for names in paper().datasets.values() for scene in names} == of_paper == set(SCALES["paper"].factors)
    # what was compared with the photographs, and nothing else
    assert {scene.name for scene in SCENES.values() if scene.verified} == {
        *("garden_512", "bonsai_800", "bear_512", "fox", *MADE)
    }


def test_a_scene_is_one_file_and_nothing_else_is_edited_to_add_one(tmp_path: Path):
    package = Path(scenes.__file__).parent
    shutil.copytree(package, tmp_path / "paper_repro", ignore=shutil.ignore_patterns("work", "results", "__pycache__"))
    fox = (package / "scenes" / "fox.toml").read_text(encoding="utf-8")
    (tmp_path / "paper_repro" / "scenes" / "porch.toml").write_text(fox.replace('folder = "fox"', 'folder = "porch"'))
    asked = ["queue", "--scale", "small", "--rows", "pop", "--results", str(tmp_path), "--list"]
    command = [sys.executable, "-P", "-m", "paper_repro", *asked]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(package.parent)])}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert "pop porch --scale small --seed 42" in done.stdout.splitlines()


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('folder = "fox"', "folder = 3", "folder is 3; it must be a text"),
        ('folder = "fox"', "", "has no folder"),
        ("shrunk = 1", "shrunk = 0", "shrunk is 0; it must be a whole number of at least 1"),
        ("verified = true", "verified = 1", "verified is 1; it must be true or false"),
        ('dataset = "further"', 'dataset = "moon"', "dataset is 'moon'; it must be one of mipnerf360, tandt"),
        ("size = [1080, 1920]", "size = [1080]", r"size is \[1080\]; it must be \[width, height\] in pixels"),
        ("small = 4", "small = 0", "factors is .*; it must be a table of whole numbers of at least 1, by scale"),
        ("shrunk = 1", "shrunken = 1", "shrunk"),
        ("size = [", "size = ", "is not a scene's TOML file: "),
    ],
)
def test_a_mistake_in_a_scenes_file_is_told_by_file_and_field(old, new, says, tmp_path: Path):
    fox = (Path(scenes.__file__).parent / "scenes" / "fox.toml").read_text(encoding="utf-8")
    assert old in fox
    (tmp_path / "fox.toml").write_text(fox.replace(old, new))
    with pytest.raises(PopError, match=rf"fox\.toml: .*{says}"):
        load_scenes(tmp_path)


def test_a_scene_as_published_is_ok(root: Path):
    found = check_scene(bonsai(), root)
    assert (found.status, found.reason, found.folder) == ("ok", "", root / "360_v2" / "bonsai")
    assert (found.n_images, found.sizes) == (VIEWS, ((WIDTH // 2, HEIGHT // 2),))
    # 0 and 8 of ten
    assert found.n_test == 2
    assert f"bonsai       ok       {VIEWS} photographs, 2 held out, 24 x 16" in "\n".join(table([found], root))


def test_a_scene_that_is_absent_is_missing_and_its_source_is_named(root: Path):
    found = [check_scene(scene, root) for scene in SCENES.values() if scene.name not in MADE]
    assert {item.scene.name for item in found if item.status != "missing"} == {"bonsai"}
    lines = table(found, root)
    assert "  train, truck: from https://repo-sam.inria.fr/" in "\n".join(lines)
    assert any(line.startswith("  truck        missing  expected: ~251 photographs, 32 held out") for line in lines)
    assert any(line.startswith("  fox          missing  expected: 50 photographs, 7 held out") for line in lines)


REFUSED: dict[str, tuple[Callable[[Path], object], dict[str, Any], str]] = {
    "a photograph is missing, which moves the split": (
        lambda folder: (folder / "images_2" / "view_003.png").unlink(),
        {},
        "1 of 10 photographs are absent, images_2/view_003.png the first, which moves the every-8th split",
    ),
    "another number of photographs": (
        lambda folder: None,
        {"n_images": VIEWS + 1},
        "has 10 photographs with a camera where 11 are published (recalled;",
    ),
    "no folder of shrunk photographs": (
        lambda folder: shutil.rmtree(folder / "images_2"),
        {},
        "images_2: is absent; the protocol takes the photographs of this folder",
    ),
    "photographs that are not shrunk": (
        lambda folder: shutil.copytree(folder / "images", folder / "images_2", dirs_exist_ok=True),
        {},
        "a photograph is 48 x 32 and its camera 48 x 32, and the protocol takes 1/2 of that",
    ),
    "one photograph of another size": (
        lambda folder: write_png(odd := folder / "images_2" / "view_007.png", read_image(odd)[:10].copy()),
        {},
        "24 x 10",
    ),
    "another size than published": (
        lambda folder: None,
        {"size": (30, 20), "verified": True},
        "has photographs of 24 x 16 where the protocol has 30 x 20: get it again from",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_a_scene_other_than_published_is_refused(root: Path, monkeypatch, what: str):
    damage, published, says = REFUSED[what]
    damage(root / "360_v2" / "bonsai")
    monkeypatch.setitem(scenes.SCENES, "bonsai", replace(bonsai(), **published))
    found = check_scene(bonsai(), root)
    assert found.status == "refused"
    assert says in found.reason


def test_a_capture_with_a_split_of_its_own_is_refused(root: Path):
    job = job_named("pop", "bonsai", "paper")
    config = job.config()
    capture = load_capture(root / "360_v2" / "bonsai", images="images_2")
    check_capture(job, config, capture)
    views = tuple(replace(view, split="test" if i == 3 else "train") for i, view in enumerate(capture.views))
    with pytest.raises(PopError, match="bonsai names a split of its own; the protocol holds out every 8th by name"):
        check_capture(job, config, replace(capture, views=views))
    with pytest.raises(PopError, match="bonsai names a split of its own"):
        check_capture(job, replace(config, test_every=5, given=None), capture)
    with pytest.raises(PopError, match="bonsai has 9 photographs with a camera where 10 are published"):
        check_capture(job, config, replace(capture, views=capture.views[:-1]))
    # and one that was read at another size
    whole = load_capture(root / "360_v2" / "bonsai", images="images")
    with pytest.raises(PopError, match="bonsai has photographs of 48 x 32 where the protocol has 24 x 16"):
        check_capture(job, config, whole)
    # the held-out views are every eighth from the first
    assert [view.name for view in capture.test_views(HOLD_OUT)] == ["view_000.png", "view_008.png"]


# the other settings of a run: where things lie, which engine takes the steps, how often something is written
OF_THE_RUN = {
    *("method", "data", "result_dir", "seed", "backend", "threads", "eval_steps", "save_steps", "checkpoint_every"),
    *("keep_checkpoints", "log_every", "max_renders", "lpips_vgg", "lpips_alex", "target_cache_mb", "progress"),
    *("verbose", "factor", "test_every"),
}
# in which settings a scale of the whole schedule differs from the paper's, of all methods and of one
OF_SCALES: dict[str, dict[str, Any]] = {
    "paper": {},
    "small": {"blur_min_pixels": 10.0},
    "no_floor": {},
    "full": {"blur_min_pixels": 10.0},
}
PAPER_SCENES = sorted(scene.name for scene in SCENES.values() if scene.in_paper)


def resolved(config: TrainConfig) -> dict[str, Any]:
    """Return what decides a training: the settings of the run, and the rasterizer's constants."""
    own = {name.removeprefix(f"{config.method}."): value for name, value in config.flat().items()}
    drawn = {f"renderer.{name}": value for name, value in asdict(config.renderer).items()}
    return {name: value for name, value in {**own, **drawn}.items() if name not in OF_THE_RUN}


def pinned(method: str, row: str | None = None, scene: str | None = None) -> dict[str, Any]:
    table = load_pinned(method)
    # where a row says a setting, that is of all scenes
    parts = (table.settings, table.scenes.get(scene or "", {}), table.rows.get(row or "", {}))
    return {name: value for part in parts for name, (value, _) in part.items()}


def assert_same(found: dict[str, Any], wanted: dict[str, Any]) -> None:
    assert found.keys() == wanted.keys()
    assert {name: (value, wanted[name]) for name, value in found.items() if value != wanted[name]} == {}


def test_every_method_has_a_table_and_every_value_a_source() -> None:
    assert {path.stem for path in FOLDER.glob("*.toml")} == set(METHODS)
    for method in METHODS:
        table = load_pinned(method)
        assert table.method == method
        parts = (table.settings, table.order, *table.rows.values(), *table.scenes.values())
        assert all(len(source) > 3 for part in parts for _, source in part.values())
        # of other people's code a commit is named, else a line means nothing
        assert any(re.search(r"\b[0-9a-f]{7}\b", source) for source in table.sources)


@pytest.mark.parametrize("method", METHODS)
def test_what_the_command_line_resolves_is_the_methods_table(method: str) -> None:
    config, _ = arguments(["capture", "--out", "out", "--method", method])
    assert_same(resolved(config), pinned(method))


@pytest.mark.parametrize("row", [row for row in ROWS if load_row(row).paper])
def test_a_row_of_the_paper_is_its_methods_table_and_what_the_row_says_on_every_scene(row: str) -> None:
    method = load_row(row).method
    for scene in PAPER_SCENES:
        if row.startswith("l1_div") or row == "l2_without_ssim":
            continue
        assert_same(resolved(job_named(row, scene, "paper").config()), pinned(method, row, scene))


@pytest.mark.parametrize("row", ["pop", "reset", "gsplat", "3dgs", "3dgs_2023", "pup", "mini_splatting", "taming",
                                 "speedy_splat"])  # fmt: skip
def test_other_scales_of_the_whole_schedule_differ_in_what_they_say_alone(row: str) -> None:
    whole = {name for name, scale in SCALES.items() if scale.steps_scaler == 1.0}
    assert whole == OF_SCALES.keys()
    method = load_row(row).method
    for name in whole - {"paper"}:
        for scene in SCALES[name].factors:
            job = job_named(row, scene, name)
            own = {key.removeprefix("strategy.") for key in job.scale.of_methods.get(method, {})}
            own |= {"sampling_factor", "importance", "budget_multiplier"} & pinned(method).keys()
            found, wanted = resolved(job.config()), {**pinned(method, row), **OF_SCALES[name]}
            if not job.scene.centred and wanted["renderer.principal_point"] == "centred":
                # drawn by gsplat's constants, see P26
                wanted |= {key: value for key, value in pinned("gsplat").items() if key.startswith("renderer.")}
                wanted |= {"profile": "gsplat_1_5", "renderer.name": "gsplat_1_5"}
            assert_same(*({key: v for key, v in part.items() if key not in own} for part in (found, wanted)))


def test_a_near_plane_is_resolved_on_the_capture_where_the_table_says_so() -> None:
    for method in METHODS:
        says = load_pinned(method).settings["near_plane"][1]
        near = TrainConfig.of(method=method).in_world(0.5).renderer.near_plane
        assert near == pinned(method)["renderer.near_plane"] * (0.5 if "capture" in says else 1.0)


# which step of `tiny_method` is which kind: densification comes at 4 (where Taming's budget has no room yet), 8, 12 and
# 16, a reset at 12
KINDS: dict[str, dict[str, int]] = {
    "pop": {"plain": 1, "densify": 4},
    "mini-splatting": {"points set anew": 7, "drawn by importance": 18, "prune by importance": 24},
    "pup": {"round": 20},
    "taming": {"densify": 8, "last densify": 16},
    "speedy-splat": {"densify, soft prune and reset": 12, "hard prune": 25},
}
USUAL = {"plain": 1, "densify": 4, "densify and reset": 12}
CHANGES: dict[str, dict[str, Any]] = {"taming": {"sampled_prunes": 3}, "speedy-splat": {"soft_prune_iters": (12,)}}
# whoever is seen is grown, and somebody is pruned, so that no event is left out for want of Gaussians
EAGER = {"grow_grad2d": 1e-7}
FAINT = -6.0


def traced(run: TrainingRun, patch: pytest.MonkeyPatch) -> list[str]:
    """Record what edits the Gaussians, in the functions that all edits go through, and whether Adam has moved any."""
    events: list[str] = []

    def noted(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def noting(*given: Any, **named: Any) -> Any:
            events.append(name)
            return call(*given, **named)

        return noting

    for name, event in (("clone", "clone"), ("split", "split"), ("prune", "prune"), ("replace_rows", "replace"),
                        ("restart", "restart"), ("reset_opacities", "reset")):  # fmt: skip
        patch.setattr(edits, name, noted(event, getattr(edits, name)))
    take = run.stepper.steps

    def steps(*given: Any) -> Any:
        before = {key: run.params[key].detach().clone() for key in KEYS}
        found = take(*given)
        if any(not torch.equal(before[key], run.params[key].detach()) for key in KEYS):
            events.append("update")
        return found

    patch.setattr(run.stepper, "steps", steps)
    return events


@pytest.mark.parametrize("backend", ["fast", "compiled"])
@pytest.mark.parametrize("method", METHODS)
def test_what_happens_to_the_gaussians_in_a_step_has_the_order_of_the_methods_table(
    method, backend, tmp_path, monkeypatch
):
    skip_without(backend)
    order = load_pinned(method).order
    kinds = {**{kind: USUAL[kind] for kind in USUAL if kind in order}, **KINDS.get(method, {})}
    assert set(kinds) <= order.keys()
    assert set(order) == set(kinds) | ({"densify"} & set(order))
    config = tiny_method(tmp_path, method, backend=backend)
    resets = {"reset_every": 0} if method == "pop" else {}
    config = replace(config, strategy=replace(config.strategy, **EAGER, **resets, **CHANGES.get(method, {})))
    run = TrainingRun(config, tiny_capture())
    events, found = traced(run, monkeypatch), {}
    for step in range(max(kinds.values()) + 1):
        run.params["opacities"].data[:20] = FAINT
        events.clear()
        run.take_steps(step + 1)
        found[step] = list(events)
    assert {kind: found[step] for kind, step in kinds.items()} == {kind: order[kind][0] for kind in kinds}
