"""Scenes under a data root: found in their published layouts, checked, and refused where the protocol has others."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from paper_repro import scenes
from paper_repro.data_check import HOLD_OUT, check_capture, check_scene, table
from paper_repro.jobs import job_named
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
from pop_fast.data import load_capture
from pop_fast.demo import make_demo
from pop_fast.errors import PopError
from pop_fast.io.images import read_image, write_png

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


def test_a_root_that_is_not_there_is_named(tmp_path: Path):
    with pytest.raises(PopError, match=r"nowhere: no such folder; name the one that holds the scenes with --data"):
        find_folder(SCENES["fox"], tmp_path / "nowhere")


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
    done = subprocess.run(
        [sys.executable, "-P", "-m", "paper_repro", *asked],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(package.parent)])},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "pop porch --scale small --seed 42" in done.stdout.splitlines()


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('folder = "fox"', "folder = 3", "folder is 3; it must be a text"),
        ('folder = "fox"', "", "has no folder"),
        ("shrunk = 1", "shrunk = 0", "shrunk is 0; it must be a whole number of at least 1"),
        ("verified = true", "verified = 1", "verified is 1; it must be true or false"),
        (
            'dataset = "further"',
            'dataset = "moon"',
            "dataset is 'moon'; it must be one of mipnerf360, tandt",
        ),
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


def test_a_missing_photograph_is_refused_as_it_moves_the_split(root: Path):
    (root / "360_v2" / "bonsai" / "images_2" / "view_003.png").unlink()
    found = check_scene(bonsai(), root)
    assert found.status == "refused"
    assert (
        "1 of 10 photographs are absent, images_2/view_003.png the first, which moves the every-8th split"
        in found.reason
    )


def test_another_number_of_photographs_is_refused(root: Path, monkeypatch):
    monkeypatch.setitem(scenes.SCENES, "bonsai", replace(bonsai(), n_images=VIEWS + 1))
    found = check_scene(bonsai(), root)
    assert found.status == "refused"
    assert "has 10 photographs with a camera where 11 are published (as is recalled;" in found.reason


def test_photographs_that_are_not_shrunk_as_published_are_refused(root: Path):
    folder = root / "360_v2" / "bonsai"
    shutil.rmtree(folder / "images_2")
    assert (
        "images_2: is absent; the protocol takes the photographs of this folder" in check_scene(bonsai(), root).reason
    )
    shutil.copytree(folder / "images", folder / "images_2")
    found = check_scene(bonsai(), root)
    assert found.status == "refused"
    assert "a photograph is 48 x 32 and its camera 48 x 32, and the protocol takes 1/2 of that" in found.reason


def test_one_photograph_of_another_size_is_refused(root: Path):
    odd = root / "360_v2" / "bonsai" / "images_2" / "view_007.png"
    write_png(odd, read_image(odd)[:10].copy())
    found = check_scene(bonsai(), root)
    assert found.status == "refused"
    assert "24 x 10" in found.reason


def test_photographs_of_another_size_than_published_are_refused(root: Path, monkeypatch):
    monkeypatch.setitem(scenes.SCENES, "bonsai", replace(bonsai(), size=(30, 20), verified=True))
    reason = check_scene(bonsai(), root).reason
    assert "has photographs of 24 x 16 where the protocol has 30 x 20: get it again from" in reason


def test_a_capture_with_a_split_of_its_own_is_refused(root: Path, monkeypatch):
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


def test_a_capture_that_was_read_at_another_size_is_refused(root: Path):
    job = job_named("pop", "bonsai", "paper")
    whole = load_capture(root / "360_v2" / "bonsai", images="images")
    with pytest.raises(PopError, match="bonsai has photographs of 48 x 32 where the protocol has 24 x 16"):
        check_capture(job, job.config(), whole)


def test_the_held_out_views_are_every_eighth_from_the_first(root: Path):
    capture = load_capture(root / "360_v2" / "bonsai", images="images_2")
    assert [view.name for view in capture.test_views(HOLD_OUT)] == ["view_000.png", "view_008.png"]
