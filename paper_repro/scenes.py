"""The scenes of the paper and the further ones: where each lies under a data root, its photographs, and their source.

Published layouts are looked for in turn, so that the archives can be unpacked side by side under one root:

    <root>/mipnerf360/garden    <root>/360_v2/garden        <root>/garden
    <root>/tandt/train          <root>/tandt_db/tandt/train
    <root>/db/playroom          <root>/tandt_db/db/playroom

Counts and sizes that were not compared with the photographs themselves are marked as such, and said to be so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from pop_fast.errors import PopError

__all__ = ["DATASETS", "MADE", "SCENES", "Dataset", "Scene", "find_folder", "scene_named"]


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Scenes that were published together.

    Attributes:
        name: as tables call it.
        parents: folders under the data root that its scenes may lie in, in the order in which they are looked for.
        source: where it comes from.
    """

    name: str
    parents: tuple[str, ...]
    source: str


@dataclass(frozen=True, kw_only=True)
class Scene:
    """One capture.

    Attributes:
        name: its name here, in results and on the command line.
        dataset: its dataset, by its key in `DATASETS`.
        folder: its folder's name.
        images: the folder with its photographs; None where the capture's list says.
        shrunk: how much smaller those photographs are than the camera model's images, as published (images_4 is 4).
        n_images: photographs with a known camera.
        size: width and height of these photographs, px.
        verified: whether count and size were compared with the photographs.
        in_paper: whether the paper reports it, in this form.
        source: where it comes from, where that is not the dataset's.
        note: what it is, where its name does not tell.
        centred: whether Inria's rasterizer, which puts the principal point in the middle of the image, may draw it.
    """

    name: str
    dataset: str
    folder: str
    images: str | None
    shrunk: int
    n_images: int
    size: tuple[int, int]
    verified: bool = False
    in_paper: bool = True
    source: str = ""
    note: str = ""
    centred: bool = True


_M360_PARENTS: Final = ("mipnerf360", "mip-nerf-360", "m360", "360_v2", "360_extra_scenes", "360", "")
DATASETS: Final = {
    "mipnerf360": Dataset(
        name="Mip-NeRF 360",
        parents=_M360_PARENTS,
        source="http://storage.googleapis.com/gresearch/refraw360/360_v2.zip (https://jonbarron.info/mipnerf360)",
    ),
    "tandt": Dataset(
        name="Tanks & Temples",
        parents=("tandt", "tandt_db/tandt", "tanks_and_temples", ""),
        source="https://repo-sam.inria.fr/fungraph/3d-gaussian-splatting/datasets/input/tandt_db.zip",
    ),
    "db": Dataset(
        name="Deep Blending",
        parents=("db", "tandt_db/db", "deep_blending", "deepblending", ""),
        source="https://repo-sam.inria.fr/fungraph/3d-gaussian-splatting/datasets/input/tandt_db.zip",
    ),
    "further": Dataset(name="further scenes", parents=("",), source=""),
}
_EXTRA: Final = (
    "http://storage.googleapis.com/gresearch/refraw360/360_extra_scenes.zip (https://jonbarron.info/mipnerf360)"
)
_GAUSSCTRL: Final = "https://github.com/ActiveVisionLab/gaussctrl"


def _m360(name: str, n_images: int, size: tuple[int, int], shrunk: int, source: str = "") -> Scene:
    # image counts of garden and bonsai are those of the further scenes below, which hold all of their photographs
    return Scene(
        name=name,
        dataset="mipnerf360",
        folder=name,
        images=f"images_{shrunk}",
        shrunk=shrunk,
        n_images=n_images,
        size=size,
        source=source,
    )


def _native(name: str, dataset: str, n_images: int, size: tuple[int, int]) -> Scene:
    return Scene(name=name, dataset=dataset, folder=name, images="images", shrunk=1, n_images=n_images, size=size)


def _further(name: str, folder: str, n_images: int, size: tuple[int, int], source: str, note: str) -> Scene:
    return Scene(
        name=name,
        dataset="further",
        folder=folder,
        images=None,
        shrunk=1,
        n_images=n_images,
        size=size,
        verified=True,
        in_paper=False,
        source=source,
        note=note,
    )


_ALL: Final = (
    _m360("bicycle", 194, (1237, 822), 4),
    _m360("flowers", 173, (1256, 828), 4, _EXTRA),
    _m360("garden", 185, (1297, 840), 4),
    _m360("stump", 125, (1245, 825), 4),
    _m360("treehill", 141, (1267, 832), 4, _EXTRA),
    _m360("room", 311, (1557, 1038), 2),
    _m360("counter", 240, (1558, 1038), 2),
    _m360("kitchen", 279, (1558, 1039), 2),
    _m360("bonsai", 292, (1559, 1039), 2),
    _native("train", "tandt", 301, (980, 545)),
    _native("truck", "tandt", 251, (979, 546)),
    _native("drjohnson", "db", 263, (1332, 876)),
    _native("playroom", "db", 225, (1264, 832)),
    _further(
        *("garden_512", "m360_garden_512", 185, (512, 512), _GAUSSCTRL),
        "Mip-NeRF 360 garden, cropped to the middle and shrunk to 512 x 512; not comparable with the paper's numbers",
    ),
    _further(
        *("bonsai_800", "m360_bonsai_800", 292, (800, 533), "https://github.com/EricXu23/Bonsaidownload"),
        "Mip-NeRF 360 bonsai at half the paper's size, recompressed; not comparable with the paper's numbers",
    ),
    replace(
        _further("bear_512", "bear_512", 96, (512, 512), _GAUSSCTRL, "a statue in a park, 512 x 512; not in the paper"),
        # the principal point lies 17 pixels from there
        centred=False,
    ),
    _further(
        *("fox", "fox", 50, (1080, 1920), "https://github.com/NVlabs/instant-ngp, data/nerf/fox"),
        "a fox's head in a room, by telephone; not in the paper",
    ),
    _further(
        *("demo", "demo", 24, (96, 72), "pop-repro makes it"),
        "a ray-traced still life, made by the program; for tests, its numbers say nothing about a method",
    ),
    _further(
        *("still_life", "still_life", 60, (320, 240), "pop-repro makes it"),
        "the same as `pop demo` writes it; to be shown, its numbers say nothing about a method",
    ),
)
SCENES: Final = {scene.name: scene for scene in _ALL}
# those that the program makes itself
MADE: Final = ("demo", "still_life")


def scene_named(name: str) -> Scene:
    """Return a scene by its name.

    Raises:
        PopError: there is none of this name; names them all.
    """
    if name not in SCENES:
        raise PopError(f"scene is '{name}'; it must be one of {', '.join(SCENES)}")
    return SCENES[name]


def find_folder(scene: Scene, root: Path) -> Path:
    """Find a scene's folder under a data root, in the first of the published layouts that has it.

    Raises:
        PopError: there is no such root, or it is in none of them; names the places and where the data comes from.
    """
    if not root.is_dir():
        raise PopError(f"{root}: no such folder; name the one that holds the scenes with --data, or in POP_DATA")
    places = [root / parent / scene.folder for parent in DATASETS[scene.dataset].parents]
    found = next((place for place in places if place.is_dir()), None)
    if found is None:
        looked = ", ".join(place.relative_to(root).as_posix() for place in places)
        raise PopError(f"{root}: has no {scene.name} (looked for {looked}); it comes from {source_of(scene)}")
    return found


def source_of(scene: Scene) -> str:
    """Say where a scene comes from."""
    return scene.source or DATASETS[scene.dataset].source
