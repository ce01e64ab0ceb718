"""The scenes that rows are trained on, and the scales that say how: photographs, their source, steps, settings.

A scene is one file of the folder `scenes`, read with errors that name file and field; one more is one file more.
Published layouts are looked for in turn, so that the archives can be unpacked side by side under one root:

    <root>/mipnerf360/garden    <root>/360_v2/garden        <root>/garden
    <root>/tandt/train          <root>/tandt_db/tandt/train
    <root>/db/playroom          <root>/tandt_db/db/playroom

Counts and sizes that were not compared with the photographs themselves are marked as such, and said to be so. A scale
says which scenes it has, how much of the schedule is trained, what else of the settings differs, and why.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, Final

from pop_fast.errors import PopError

FOLDER: Final = Path(__file__).resolve().parent / "scenes"
_M360_PARENTS: Final = ("mipnerf360", "mip-nerf-360", "m360", "360_v2", "360_extra_scenes", "360", "")
# of a scene's file: what each field must be
_KINDS: Final = {
    **dict.fromkeys(("dataset", "folder", "images", "source", "note"), (str, "a text")),
    **dict.fromkeys(("order", "shrunk", "n_images"), (int, "a whole number of at least 1")),
    **dict.fromkeys(("verified", "centred"), (bool, "true or false")),
}
# those that the program makes itself
MADE: Final = ("demo", "still_life")
# theta_blur comes to 10.7 pixels in the paper's smallest images, and to less in images smaller than those
_FLOOR: Final = {"strategy.blur_min_pixels": 10.0}
# Mini-Splatting's 3.5 million points are one to three of a hundred pixels of the paper's views; so many are these
_POINTS: Final = {
    scale: {"mini-splatting": {"strategy.reinit_points": count}}
    for scale, count in (("toy", 3_000), ("shown", 50_000), ("small", 200_000), ("full", 1_000_000))
}


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Scenes that were published together."""

    name: str  # as tables call it
    # folders under the data root that its scenes may lie in, in the order in which they are looked for
    parents: tuple[str, ...]
    source: str  # where it comes from


@dataclass(frozen=True, kw_only=True)
class PaperScene:
    """One capture."""

    name: str  # its name here, in results and on the command line, and of its file
    dataset: str  # its dataset, by its key in `DATASETS`
    order: int  # its place among the scenes of the dataset
    folder: str  # its folder's name
    images: str | None = None  # the folder with its photographs; None where the capture's list says
    shrunk: int  # how much smaller those photographs are than the camera model's images, as published (images_4 is 4)
    n_images: int  # photographs with a known camera
    size: tuple[int, int]  # width and height of these photographs, px
    # the scales that have it, each with what the photographs are shrunk by after they were read
    factors: Mapping[str, int]
    verified: bool = False  # whether count and size were compared with the photographs
    source: str = ""  # where it comes from, where that is not the dataset's
    note: str = ""  # what it is, where its name does not tell
    # whether Inria's rasterizer, which puts the principal point in the middle of the image, may draw it
    centred: bool = True

    @property
    def in_paper(self) -> bool:
        """Whether the paper reports it, in this form."""
        return "paper" in self.factors


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


def load_scene(path: Path) -> PaperScene:
    """Read a scene's file.

    Raises:
        PopError: it is not TOML, or a field is absent, unknown or not what it must be; names it.
    """
    try:
        found = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise PopError(f"{path}: is not a scene's TOML file: {error}") from error
    require_fields(path, found, PaperScene, "scene")

    def fail(field: str, must: str) -> PopError:
        return PopError(f"{path}: {field} is {found[field]!r}; it must be {must}")

    for name, (kind, must) in _KINDS.items():
        if name in found and (type(found[name]) is not kind or (kind is int and found[name] < 1)):
            raise fail(name, must)
    size, factors = found["size"], found["factors"]
    if not isinstance(size, list) or len(size) != 2 or not all(map(_is_count, size)):
        raise fail("size", "[width, height] in pixels")
    if not isinstance(factors, dict) or not factors or not all(map(_is_count, factors.values())):
        raise fail("factors", "a table of whole numbers of at least 1, by scale")
    if found["dataset"] not in DATASETS:
        raise fail("dataset", f"one of {', '.join(DATASETS)}")
    return PaperScene(name=path.stem, **{**found, "size": (size[0], size[1])})


def require_fields(path: Path, found: Mapping[str, Any], kind: type[Any], called: str) -> None:
    """Hold the fields of a TOML file to those of a dataclass, whose `name` is the file's.

    Raises:
        PopError: one is unknown, or absent and has no default; names it.
    """
    known = {field.name: field for field in fields(kind) if field.name != "name"}
    for name in [*known, *found]:
        if name not in known:
            raise PopError(f"{path}: {name} is not a field of a {called}; the fields are {', '.join(known)}")
        if name not in found and known[name].default is MISSING:
            raise PopError(f"{path}: has no {name}")


def load_scenes(folder: Path = FOLDER) -> dict[str, PaperScene]:
    """Read every scene, in the order of the datasets and of `PaperScene.order`.

    Raises:
        PopError: as `load_scene`.
    """
    keys = list(DATASETS)
    found = [load_scene(path) for path in folder.glob("*.toml")]
    found.sort(key=lambda scene: (keys.index(scene.dataset), scene.order, scene.name))
    return {scene.name: scene for scene in found}


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 1


SCENES: Final = load_scenes()


def scene_named(name: str) -> PaperScene:
    """Return a scene by its name.

    Raises:
        PopError: there is none of this name; names them all.
    """
    if name not in SCENES:
        raise PopError(f"scene is '{name}'; it must be one of {', '.join(SCENES)}")
    return SCENES[name]


def find_folder(scene: PaperScene, root: Path) -> Path:
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


def source_of(scene: PaperScene) -> str:
    """Say where a scene comes from."""
    return scene.source or DATASETS[scene.dataset].source


@dataclass(frozen=True, kw_only=True)
class Scale:
    """How much of the published protocol a run follows."""

    name: str  # its name in results and on the command line
    about: str  # one sentence for people
    # its scenes, each with what its photographs are shrunk by after they were read, by the scenes' files
    factors: Mapping[str, int]
    steps_scaler: float = 1.0  # multiplies every step number of the method
    # what else differs from the method's own values, in the names of `pop_fast.train.TrainConfig`; those of density
    # control under "strategy."
    settings: Mapping[str, Any] = field(default_factory=dict)
    # what else differs for one method alone, likewise
    of_methods: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    # steps between two resets, for the rows that have resets, and the step after which large Gaussians are pruned, for
    # the rows that prune them; None leaves both as the scaled schedule has them, no sooner than 3,000 steps
    reset_every: int | None = None
    log_every: int = 100  # steps between two points of the curves
    checkpoint_every: int = 500  # steps that a kill can cost


def _factors(scale: str) -> dict[str, int]:
    return {scene.name: scene.factors[scale] for scene in SCENES.values() if scale in scene.factors}


_ALL: Final = (
    Scale(
        name="toy",
        about="the demo capture in seconds: that everything runs, and nothing more",
        factors=_factors("toy"),
        # 300 steps, in which density control acts 14 times and resets, where it does, at 30, 60, 90 and 120
        steps_scaler=0.01,
        settings={**_FLOOR, "strategy.refine_every": 10},
        of_methods=_POINTS["toy"],
        reset_every=30,
        log_every=10,
        checkpoint_every=100,
    ),
    Scale(
        name="shown",
        about="the still life of the demo at its size, a tenth of the schedule: pictures that may be published",
        factors=_factors("shown"),
        steps_scaler=0.1,
        settings=_FLOOR,
        of_methods=_POINTS["shown"],
    ),
    Scale(
        name="small",
        about="real photographs for a CPU: the whole schedule, small images, theta_blur at least 10 pixels",
        factors=_factors("small"),
        settings=_FLOOR,
        of_methods=_POINTS["small"],
    ),
    Scale(
        name="no_floor",
        about="fox at half its size and the whole schedule, where theta_blur is 10.4 pixels by itself",
        factors=_factors("no_floor"),
        of_methods=_POINTS["small"],
    ),
    Scale(
        name="full",
        about="bonsai_800 at its size and the whole schedule, theta_blur at least 10 pixels",
        factors=_factors("full"),
        settings=_FLOOR,
        of_methods=_POINTS["full"],
        log_every=25,
    ),
    Scale(name="paper", about="the published protocol", factors=_factors("paper"), checkpoint_every=1_000),
)


SCALES: Final = {scale.name: scale for scale in _ALL}


for _scene in SCENES.values():
    for _name in _scene.factors:
        if _name not in SCALES:
            raise PopError(f"scenes/{_scene.name}.toml: factors.{_name} is not a scale; they are {', '.join(SCALES)}")


def scale_named(name: str) -> Scale:
    """Return a scale by its name.

    Raises:
        PopError: there is none of this name; names them all.
    """
    if name not in SCALES:
        raise PopError(f"scale is '{name}'; it must be one of {', '.join(SCALES)}")
    return SCALES[name]
