"""The rows of the paper's tables and figures, and one training of a row: with a scene, a scale and a seed.

A row is one file of `configs`, read with errors that name file and field. It names a method of `pop train` and the
options in which it differs from it, on the whole schedule of the paper. Options that belong to a dataset or a scene
alone stand in the table `[scenes]`, by its key there or by the scene's name. At a shorter schedule, step numbers are
scaled as the program scales the defaults of a method (`DensityControl.scaled`), so that "blur from 3,000 to 4,000"
stays a fortieth of the schedule.
"""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from paper_repro import results
from paper_repro.scenes import DATASETS, SCENES, PaperScene, Scale, require_fields, scale_named, scene_named
from pop_fast.errors import PopError
from pop_ref.registry import Registry

if TYPE_CHECKING:
    from pop_fast.train import TrainConfig

CONFIGS: Final = Path(__file__).resolve().parent / "configs"
# in the order of the tables; what they hold is in the files
_ORDER: Final = (
    *("3dgs", "3dgs_2023", "gsplat", "pup", "pup_star", "mini_splatting", "mini_splatting_star"),
    *("taming", "speedy_splat", "pop"),
    *("l2", "l2_blur", "l2_pop", "reset", "blur_3k_4k", "blur_3k_11k", "blur_3k_15k"),
    *("l2_without_ssim", *(f"l1_div_{n}" for n in (1, 2, 5, 10, 20, 50, 100))),
    *("final_prune", "opacity_entropy"),
    *("pop_visible", "pop_any_view", "l2_blur_any_view", "pop_sum", "pop_size_prune", "pop_prune_002"),
)


def own_rows(folder: Path) -> dict[str, Path]:
    """List the files of rows: those of the paper and its readings in the order of the tables, then any others."""
    names = dict.fromkeys((*_ORDER, *sorted(path.stem for path in folder.glob("*.toml"))))
    return {name: folder / f"{name}.toml" for name in names}


# another package adds a row as the path of its file, under the entry point group or with `ROWS.register`
ROWS: Final[Registry[Path]] = Registry(
    "row", "pop_splatting.rows", own_rows(CONFIGS), needs=("read_text",), error=PopError
)
# floats of one Gaussian in the files whose size the tables give: gsplat's checkpoint, and Inria's PLY with its normals
_BYTES: Final = (236, 248)
# git ignores it; everything in it can be made again
WORK: Final = results.HOME / "work"
SEED: Final = 42
# how often the held-out views are measured, evenly over the schedule: curves of Gaussians per pixel are made of these
_MEASURED: Final = 15
# step numbers that are settings of a run and not of its strategy
_STEPS: Final = ("max_steps", "sh_interval", "l2_stop_iter")


@dataclass(frozen=True, kw_only=True)
class Row:
    """What a row of a table is trained with."""

    name: str  # of the row, and of its file
    title: str  # what it is, in a few words
    method: str  # its name for `pop train --method`
    options: tuple[str, ...]  # the options of `pop train` in which it differs from that, on the whole schedule
    tables: tuple[int, ...]  # the paper's tables that it stands in
    figures: tuple[str, ...]  # the paper's figures that it stands in
    paper: Mapping[str, str]  # its name in the paper's tables, by table; empty beyond the paper
    description: str  # about ten lines: what the method does, from which sources, and what is left out
    # time of a training over that of POP, for the order of a queue; from the paper's table where it has one
    cost: float
    bytes_per_gaussian: int  # of the file whose size the paper's table gives
    scenes: Mapping[str, tuple[str, ...]]  # further options by dataset or scene; the scene's own come last
    # the row from whose training it begins, where that is finished, or None; see `paper_repro.train_row`
    base: str | None = None

    def options_for(self, scene: PaperScene) -> tuple[str, ...]:
        """Return its options on a scene: its own, the dataset's, the scene's."""
        return (*self.options, *self.scenes.get(scene.dataset, ()), *self.scenes.get(scene.name, ()))


def load_row(name: str, folder: Path = CONFIGS) -> Row:
    """Read a row's file.

    Raises:
        PopError: there is no such row, or its file is not TOML, or a field is absent, unknown or of the wrong type.
    """
    path = _file_of(name, folder)
    if not path.is_file():
        raise PopError(f"row is '{name}'; it must be one of {', '.join(ROWS)}")
    try:
        found = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise PopError(f"{path}: is not TOML: {error}") from error
    found = {"scenes": {}, **found}
    require_fields(path, found, Row, "row")
    return _checked(name, path, found)


def added_rows() -> list[Row]:
    """Read the rows that have no place in the order of the tables: new ones, and those of other packages."""
    return [load_row(name) for name in ROWS if name not in _ORDER]


def _file_of(name: str, folder: Path) -> Path:
    return ROWS[name] if name not in _ORDER and name in ROWS else folder / f"{name}.toml"


def load_rows() -> list[Row]:
    """Read every row, in the order of the tables."""
    return [load_row(name) for name in ROWS]


def header_of(name: str, folder: Path = CONFIGS) -> dict[str, str]:
    """Read what a row's file opens with: its claim, the hardware and the hours.

    Raises:
        PopError: one of the three is absent.
    """
    path = _file_of(name, folder)
    found: dict[str, str] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        key, _, text = line.removeprefix("#").strip().partition(": ")
        found[key.lower()] = text.strip()
    for key in ("claim", "hardware", "hours"):
        if not found.get(key):
            raise PopError(f"{path}: its first lines must be '# Claim: ...', '# Hardware: ...' and '# Hours: ...'")
    return found


def _checked(name: str, path: Path, found: Mapping[str, Any]) -> Row:
    def fail(field: str, must: str) -> PopError:
        return PopError(f"{path}: {field} is {found[field]!r}; it must be {must}")

    for field in ("title", "method", "description"):
        if not isinstance(found[field], str) or not found[field].strip():
            raise fail(field, "a text")
    for field in ("options", "figures"):
        if not _is_texts(found[field]):
            raise fail(field, "a list of texts")
    if not isinstance(found["tables"], list) or not all(type(number) is int for number in found["tables"]):
        raise fail("tables", "a list of whole numbers")
    for field, inner in (("paper", lambda value: isinstance(value, str)), ("scenes", _is_texts)):
        if not isinstance(found[field], dict) or not all(map(inner, found[field].values())):
            raise fail(field, "a table of texts" if field == "paper" else "a table of lists of texts")
    if found.get("base") is not None and found["base"] not in ROWS:
        raise fail("base", f"one of {', '.join(ROWS)}")
    strange = next((key for key in found["scenes"] if key not in (*DATASETS, *SCENES)), None)
    if strange is not None:
        raise PopError(f"{path}: scenes.{strange} is neither a dataset nor a scene")
    cost, size = found["cost"], found["bytes_per_gaussian"]
    if not isinstance(cost, int | float) or isinstance(cost, bool) or not 0.0 < cost <= sys.float_info.max:
        raise fail("cost", "a number above 0")
    if size not in _BYTES:
        raise fail("bytes_per_gaussian", " or ".join(map(str, _BYTES)))
    made = {field: tuple(found[field]) for field in ("options", "tables", "figures")}
    made |= {"description": found["description"].strip(), "cost": float(cost)}
    made["scenes"] = {key: tuple(value) for key, value in found["scenes"].items()}
    return Row(name=name, **{**found, **made})


def _is_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)


class NotTrainableError(PopError):
    """Say that the program cannot train a row: it lacks the method, or does not take an option.

    Attributes:
        status: the exit status of `pop-repro run`, by which a queue tells it from a failure.
    """

    status: Final = 69


@dataclass(frozen=True)
class Job:
    """One training and its result."""

    row: Row
    scene: PaperScene
    scale: Scale
    seed: int = SEED

    def __str__(self) -> str:
        # the words after `pop-repro run`
        return f"{self.row.name} {self.scene.name} --scale {self.scale.name} --seed {self.seed}"

    @property
    def factor(self) -> int:
        """What the scene's photographs are shrunk by, relative to the published size."""
        return self.scale.factors[self.scene.name]

    @property
    def cost(self) -> float:
        """About how long it takes, in no unit: pixels times steps times what the paper says of the method."""
        width, height = self.scene.size
        return self.row.cost * width * height / self.factor**2 * self.scale.steps_scaler

    def file(self, folder: Path) -> Path:
        """Return the file of its row's results in a folder of results."""
        return results.path_of(self.scale.name, self.row.name, folder)

    def is_done(self, folder: Path) -> bool:
        """Tell whether it has a result in a folder of results.

        Raises:
            PopError: the file of the row's results is damaged.
        """
        return (self.scene.name, self.seed) in results.kept(self.scale.name, self.row.name, folder)

    def result(self, folder: Path) -> results.Result | None:
        """Read its result in a folder of results; None where there is none.

        Raises:
            PopError: the result is damaged, or does not agree with itself.
        """
        return results.find(self.scale.name, self.row.name, self.scene.name, self.seed, folder)

    def work(self, folder: Path) -> Path:
        """Return the place of its checkpoints in a work folder."""
        return folder / self.scale.name / self.row.name / f"{self.scene.name}_{self.seed}"

    def words(self) -> list[str]:
        """Return the words after `pop train` that say its row, on the whole schedule."""
        return ["--method", self.row.method, *self.row.options_for(self.scene)]

    def config(self, **more: Any) -> TrainConfig:
        """Make its settings.

        Args:
            more: settings of the run that do not belong to the row: data, result_dir, threads, backend, ...

        Raises:
            NotTrainableError: the program has no such method or option; names row and words.
        """
        from pop_fast.train import TrainConfig
        from pop_ref.constants import GSPLAT_1_5, profile_named

        scaler, whole = self.scale.steps_scaler, _whole(self)
        every = self.scale.reset_every
        resets = {} if every is None or whole.strategy.reset_every == 0 else {"strategy.reset_every": every}
        sizes = {} if every is None or not whole.strategy.prune_too_big else {"strategy.prune_too_big_after": every}
        drawable = self.scene.centred or profile_named(whole.profile).principal_point == "used"
        said = {
            "log_every": self.scale.log_every,
            "checkpoint_every": self.scale.checkpoint_every,
            "eval_steps": _measured_at(whole.max_steps, scaler),
            # the Gaussians are saved at the end alone, which always counts
            "save_steps": (),
            **self.scale.settings,
            **self.scale.of_methods.get(whole.method, {}),
            **_scaled(whole, scaler),
            **resets,
            **sizes,
            **({} if drawable else {"profile": GSPLAT_1_5.name}),
            "seed": self.seed,
            "factor": self.factor,
            "progress": False,
        }
        return TrainConfig.of(method=whole.method, steps_scaler=scaler, **{**said, **more})


def job_named(row: str, scene: str, scale: str, seed: int = SEED) -> Job:
    """Make a job from names.

    Raises:
        PopError: a name is unknown, or the scale does not have the scene.
    """
    job = Job(load_row(row), scene_named(scene), scale_named(scale), seed)
    if scene not in job.scale.factors:
        raise PopError(f"scale '{scale}' has no {scene}; its scenes are {', '.join(job.scale.factors)}")
    return job


def jobs_of(
    scale: str, rows: Iterable[str] = ROWS, scenes: Iterable[str] | None = None, seeds: Iterable[int] = (SEED,)
) -> list[Job]:
    """List the jobs of a scale, the cheapest first.

    Raises:
        PopError: a name is unknown, or the scale does not have a scene.
    """
    chosen = list(scale_named(scale).factors if scenes is None else scenes)
    # what is named twice is one job
    asked = dict.fromkeys((row, scene, seed) for seed in seeds for scene in chosen for row in rows)
    jobs = [job_named(row, scene, scale, seed) for row, scene, seed in asked]
    return sorted(jobs, key=lambda job: job.cost)


def trainable(job: Job) -> bool:
    """Tell whether the program has a job's method and takes its options."""
    try:
        _whole(job)
    except NotTrainableError:
        return False
    return True


def missing_method(row: Row) -> str | None:
    """Say that the program does not know a row's method, or None where it does."""
    from pop_fast.train.presets import METHODS

    if row.method in METHODS:
        return None
    return f"row {row.name}: this version of pop has no method '{row.method}'; it has {', '.join(METHODS)}"


def _whole(job: Job) -> TrainConfig:
    """Read a row's options as `pop train` does, on the whole schedule."""
    missing = missing_method(job.row)
    if missing is not None:
        raise NotTrainableError(missing)
    try:
        return _whole_of(job.row.method, job.row.options_for(job.scene))
    except PopError as error:
        words = " ".join(job.words())
        raise NotTrainableError(
            f"row {job.row.name}: this version of pop train does not take {words}: {error}"
        ) from error


@lru_cache
def _whole_of(method: str, options: tuple[str, ...]) -> TrainConfig:
    from pop_fast.train import TrainConfig

    return TrainConfig.from_options(options, method=method)


def _scaled(whole: TrainConfig, scaler: float) -> dict[str, Any]:
    """Return what a row's options say, its step numbers as they are on a schedule `scaler` times as long."""
    given = whole.given
    said = {} if given is None else dict(given.settings)
    scaled = whole.strategy.scaled(scaler)
    for name, value in said.items():
        group, dot, field = name.partition(".")
        if dot and group == whole.method:
            said[name] = getattr(scaled, field)
        elif name in _STEPS and value is not None:
            said[name] = max(round(value * scaler), 1)
    return said


def _measured_at(max_steps: int, scaler: float) -> tuple[int, ...]:
    last = max_steps * scaler
    return tuple(sorted({max(round(last * i / _MEASURED), 1) for i in range(1, _MEASURED)}))
