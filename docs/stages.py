"""The stages of the method, where the paper states each, and their functions as the sources have them."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Stage:
    """A row of the Rosetta table: the modules that hold a step have the same names in each room."""

    title: str
    paper: str
    modules: tuple[str, ...]
    also_fast: tuple[str, ...] = ()  # files of pop_fast under other names, where torch or gsplat's interface sets them
    also_cuda: tuple[str, ...] = ()  # files of cuda_ext/csrc that hold several stages


_SCORES = ("scores.cuh", "scores.cu")

STAGES = (
    Stage("raw parameters to scales, opacities, unit quaternions", "3.1", ("activations",), ("stages/covariance.py",)),
    Stage("covariances from rotations and scales", "3.1", ("covariance",)),
    Stage("spherical harmonics to colour", "3.1", ("harmonics",)),
    Stage("world to camera, near plane", "3.1", ("camera",), ("stages/projection.py",)),
    Stage("projection of means and covariances (EWA)", "3.1", ("projection",)),
    Stage("low-pass, conics, extents, off-screen cull", "3.1", ("footprint",), ("stages/projection.py",)),
    Stage("tile lists in depth order", "3.1", ("tiles",), ("compiled/compositing.py",)),
    Stage("falloff and alpha of one splat at one pixel", "eqs. 1, 11", ("alpha",), ("stages/blend/tile_groups.py",)),
    Stage("blending with early ray termination", "eq. 1", ("compositing", "pixel"), ("compiled/compositing.py",)),
    Stage("dominant Gaussians", "eq. 5", ("dominance",), ("stages/compositing.py",)),
    Stage("a whole view", "eq. 1", ("render", "splatting", "depth"), ("api/rasterize.py", "compiled/splatting.py")),
    Stage(
        "L1, L2, SSIM and both objectives",
        "eqs. 2, 4, 9",
        ("losses", "ssim", "loss_magnitudes"),
        ("compiled/losses.py",),
    ),
    Stage("importance mask and POP loss", "eqs. 7, 8", ("polarization",)),
    Stage("terms for few photographs: sparse depth, mean opacity, mean scale", "–", ("regularizers",)),
    Stage("density control", "eqs. 3, 6", ("density", "density_config", "density_rows")),
    Stage("Adam and its schedules", "4.1", ("optimizer",), ("train/model.py", "train/schedule.py")),
    Stage("exposure of photographs, random backgrounds", "–", ("appearance",), ("train/appearance.py",)),
    Stage("corrections of cameras", "–", ("refinement",), ("stages/appearance.py",)),
    Stage("one training step", "eq. 9", ("training", "recipes"), ("train/torch_stepper.py",)),
    Stage(
        "sums of weights, pixels and distances over a view",
        "4.2",
        ("contributions",),
        ("compiled/scores.py",),
        _SCORES,
    ),
    Stage(
        "Speedy-Splat's score",
        "4.2",
        ("sensitivity",),
        ("stages/contributions.py", "compiled/scores.py"),
        _SCORES,
    ),
    Stage(
        "PUP 3D-GS's score",
        "4.2",
        ("fisher",),
        ("stages/contributions.py", "compiled/scores.py"),
        _SCORES,
    ),
    Stage(
        "Mini-Splatting's points and importance", "4.2", ("chord", "mini_splatting"), ("compiled/scores.py",), _SCORES
    ),
    Stage("Taming-3DGS's budget and score", "4.2", ("taming",)),
    Stage("selection by score, by mass, by draw", "4.2", ("selection",)),
    Stage("exact tile lists (SnugBox, AccuTile)", "4.2", ("tight_tiles",), ("stages/tiles.py",)),
    Stage(
        "distance of every decision from flipping", "–", ("margins", "extent_margins", "pixel_margins", "magnitudes")
    ),
)

# modules of pop_ref that are data or types, not stages
NOT_STAGES = frozenset(
    {"__init__", "_shapes", "ambiguities", "constants", "notation", "records", "registry", "settings"}
    # whole trainings of the methods, which the laws of strategies and of steps are held to, and what they train
    | {"methods", "scripted", "short_training"}
)
# stages whose laws stand in a file of another name: whole views, and what is tested elsewhere
LAWS_ELSEWHERE = {
    "render": "pop_ref/conformance/laws/test_whole.py",
    "depth": "pop_ref/conformance/laws/test_signature_depth.py",
    "training": "tests/golden",
    "appearance": "tests/oracle/test_losses.py",
    "refinement": "tests/oracle/test_losses.py",
    "regularizers": "tests/oracle/test_losses.py",
    "margins": "tests/oracle/test_margins.py",
}


def functions(path: Path) -> dict[str, list[str]]:
    """Give the public functions of a source file, in order, each with its parameters' names."""
    if not path.is_file():
        return {}
    found = (n for n in ast.parse(path.read_text(encoding="utf-8")).body if isinstance(n, ast.FunctionDef))
    return {f.name: [a.arg for a in (*f.args.args, *f.args.kwonlyargs)] for f in found if f.name[0] != "_"}


def files(room: str, stage: Stage) -> Iterator[Path]:
    """Give the files of a stage in one room, where they exist."""
    suffixes = (".cuh", ".cu") if room == "cuda_ext/csrc" else (".py",)
    folder = ROOT / ("pop_fast/stages" if room == "pop_fast" else room)
    for module in stage.modules:
        for suffix in suffixes:
            path = folder / f"{module}{suffix}"
            if path.is_file():
                yield path
    if room == "pop_fast":
        yield from (ROOT / room / name for name in stage.also_fast)
    if room == "cuda_ext/csrc":
        yield from (ROOT / room / name for name in stage.also_cuda)


def laws(stage: Stage) -> Iterator[Path]:
    """Give the law files of a stage, those of its modules, or the place named in `LAWS_ELSEWHERE`."""
    for module in stage.modules:
        if module in LAWS_ELSEWHERE:
            yield ROOT / LAWS_ELSEWHERE[module]
        folder = ROOT / "pop_ref" / "conformance" / "laws"
        yield from sorted(folder.glob(f"test_{module}.py"))
        yield from sorted(folder.glob(f"test_{module}_*.py"))
