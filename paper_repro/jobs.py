"""One training of the reproduction: a row, a scene, a scale and a seed, as the settings that `pop train` would run.

A row's options count steps of the paper's whole schedule. At a shorter one they are scaled as the program scales the
defaults of a method (`DensityControl.scaled`), so that "blur from 3,000 to 4,000" stays a fortieth of the schedule.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from paper_repro import results
from paper_repro.rows import ROWS, Row, load_row
from paper_repro.scales import Scale, scale_named
from paper_repro.scenes import PaperScene, scene_named
from pop_fast.errors import PopError

if TYPE_CHECKING:
    from pop_fast.train import TrainConfig

# git ignores it; everything in it can be made again
WORK: Final = Path(__file__).resolve().parent / "work"
SEED: Final = 42
# how often the held-out views are measured, evenly over the schedule: curves of Gaussians per pixel are made of these
_MEASURED: Final = 15
# step numbers that are settings of a run and not of its strategy
_STEPS: Final = ("max_steps", "sh_interval", "l2_stop_iter")


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

        scaler = self.scale.steps_scaler
        whole = _whole(self)
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
    jobs = [job_named(row, scene, scale, seed) for seed in seeds for scene in chosen for row in rows]
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
