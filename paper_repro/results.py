"""Finished runs: the fields of one, its line of JSON, and the folder of results that it stands in.

A row's results lie in `<folder>/<scale>/<row>.jsonl`, sorted by scene and seed. Tables, figures, claims and the status
table are made from these files and from paper.toml alone. Two queues can write to a folder at once: a file is read,
changed and replaced as a whole under a lock, and one that git has merged from two branches holds the lines of both.

The curve lies in the line as tables of columns, one for each set of values that its points have, so that a name stands
there once. Errors name the file, the line and the field.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import math
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from paper_repro.scenes import SCALES, scale_named
from pop_fast.errors import PopError
from pop_fast.io.atomic import write_file

SCHEMA: Final = 2
LPIPS_VARIANTS: Final = ("vgg_01", "alex_norm", "alex_01")
BINS: Final = 50  # of the opacity histogram over [0, 1]
# what the timing of a run ends with that had not its machine to itself
UNTIMED: Final = "; beside other trainings, so not compared"

# names that cannot be identifiers, by the identifier that stands for them here
_KEYS: Final = {"opacity_below_01": "opacity_below_0.1", "opacity_above_09": "opacity_above_0.9"}
_PHASES: Final = ("load", "train", "evaluate")
# what is said of every run about how it was measured
_PROTOCOL: Final = {
    "split": str,
    "test_views": int,
    "images": str,
    "factor": int,
    "width": int,
    "height": int,
    "resize": str,
    "ssim": str,
    "lpips": str,
    "timing": str,
    "checkpoint_bytes_per_gaussian": int,
}
_RUN: Final = (r"[0-9a-f]{12}", "twelve hex digits")
COMMIT: Final = r"[0-9a-f]{7,40}(?:-dirty)?"
# and of one whose first steps are another run's, that run's id, or were taken by another commit, that commit
_OF_FIRST_STEPS: Final = {"base": _RUN, "begun": (COMMIT, "a git commit")}
_HASH: Final = (r"[0-9a-f]{64}", "a SHA-256 in hex digits")
_AGAIN: Final = "train the row again with pop-repro run --again"


@dataclass(frozen=True)
class Result:
    """What one finished run says of itself."""

    scale: str  # a name of `paper_repro.scenes`
    row: str  # the configuration, by the name of its file in `configs`
    scene: str  # the capture, by its name here ("fox", "bonsai_800", "kitchen", ...)
    seed: int  # of every random number of the run
    run: str  # twelve hex digits of the hash of configuration, data and seed
    commit: str | None  # the git commit that ran, to the end; None outside a clone
    config_hash: str  # of the configuration
    data_hash: str  # of the capture as it was loaded: names, photographs, masks, cameras, points, and what else is used
    machine: str  # the processor, and after ", " the GPU where one was used
    # family, model, stepping and instructions of the processor, by which two machines are of one kind; None where
    # nothing tells them
    cpu: str | None
    engine: str  # what took the steps: "native", "cuda", or "torch (BACKEND)", autograd over a backend
    threads: int  # CPU threads
    versions: Mapping[str, Any]  # of Python and the packages that compute
    # split, images, size, metrics, timing, and the bytes of a Gaussian in a checkpoint; "base" is the id of the run
    # that its first steps are from, whose time is in its own, "begun" another commit that took them
    protocol: Mapping[str, Any]
    schedule: Mapping[str, Any]  # the settings as they were run, by dotted name
    # by the clock, of "load", "train" and "evaluate"; "cpu" is the processor time of "train" over all threads, where a
    # CPU trained and it was counted
    seconds: Mapping[str, float]
    num_gaussians: int  # at the end
    checkpoint_mib: float  # size of the parameters in float32, MiB
    psnr: float  # dB, mean over the held-out views
    ssim: float  # mean over the held-out views
    lpips: Mapping[str, float | None]  # by variant; None where its weights were not given
    lpips_reason: str | None  # why a variant is None; None when none is
    # Gaussians blended a pixel, mean over the held-out views; None where the engine does not count
    n_blended: float | None
    n_traversed: float | None  # list entries visited a pixel, likewise
    opacity_below_01: float  # share of Gaussians with opacity under 0.1 ("opacity_below_0.1" in the file)
    opacity_above_09: float  # share of Gaussians with opacity over 0.9 ("opacity_above_0.9" in the file)
    opacity_histogram: tuple[int, ...]  # counts in 50 equal bins over [0, 1]
    # what was logged during training, by rising "step"; a point has only what was measured at its step. What begins
    # with "grad_" and "probe_" is of a few training views that are rendered all along, "psnr_test" of the held-out
    # views
    curve: tuple[Mapping[str, Any], ...]
    per_view: Mapping[str, Mapping[str, float]]  # "psnr" and "ssim" of every held-out view, by its name
    # SHA-256 of the PLY of the Gaussians at the end, which has all their bits; None where it is not known
    ply_hash: str | None
    files: Mapping[str, str]  # what the run left to be published, by name, each with the SHA-256 of its content

    @property
    def training_seconds(self) -> float:
        """What the training takes of a machine that does nothing else, as far as it is known, s.

        Processor time a thread where it was counted: the clock goes on through pauses and the work of others.
        """
        return self.seconds["cpu"] / self.threads if "cpu" in self.seconds else self.seconds["train"]

    @property
    def is_timed(self) -> bool:
        """Whether that can be compared: a CPU's by the clock cannot, since it may have done other work."""
        alone = not self.protocol["timing"].endswith(UNTIMED)
        return alone and ("cpu" in self.seconds or ", " in self.machine)

    @property
    def trained_on(self) -> str:
        """Say of the training time what it is a time of: machine and kind of its processor, engine, threads."""
        # processors of several generations have one name; on a GPU they matter little
        kind = "" if ", " in self.machine else f" ({self.cpu or 'of an unknown kind'})"
        return f"{self.machine}{kind}, {self.engine}, {self.threads} thread{'' if self.threads == 1 else 's'}"

    def at(self, step: int, key: str = "num_gaussians") -> float | None:
        """Give a value of the curve at a step, linearly between the logged ones; None outside of them."""
        known = [(int(p["step"]), float(p[key])) for p in self.curve if p.get(key) is not None]
        for (s0, v0), (s1, v1) in pairwise(known):
            if s0 <= step <= s1:
                return v0 + (v1 - v0) * (step - s0) / (s1 - s0)
        return known[0][1] if len(known) == 1 and known[0][0] == step else None


def most_timed_on(runs: Iterable[tuple[str, Result]]) -> str | None:
    """Return on which machine most rows were timed, one with POP before others; None where no time compares.

    Args:
        runs: each with the row that it stands for.
    """
    rows: dict[str, set[str]] = {}
    for row, run in runs:
        if run.is_timed:
            rows.setdefault(run.trained_on, set()).add(row)
    return max(sorted(rows), key=lambda where: ("pop" in rows[where], len(rows[where])), default=None)


def to_line(result: Result) -> str:
    """Write a result as one line of JSON, without the end of the line.

    Raises:
        PopError: a field is not what it must be, or does not agree with another one.
    """
    values = {_KEYS.get(f.name, f.name): getattr(result, f.name) for f in fields(Result)}
    _parse(values, f"the result of {result.row} on {result.scene}, seed {result.seed}")
    values["curve"] = _packed(result.curve)
    return json.dumps({"schema": SCHEMA, **values}, allow_nan=False, separators=(",", ":"))


def from_line(line: str, where: str) -> Result:
    """Read a result from its line.

    Args:
        line: of a file of results.
        where: file and line, for messages.

    Raises:
        PopError: not JSON, another schema, a field that is absent, unknown or wrong, or one that does not agree with
            another.
    """
    try:
        values = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise PopError(f"{where}: is not JSON ({error}); {_AGAIN}") from None
    if not isinstance(values, dict):
        raise PopError(f"{where}: is {type(values).__name__}, not an object; {_AGAIN}")
    if values.pop("schema", None) != SCHEMA:
        raise PopError(f"{where}: schema must be {SCHEMA}; {_AGAIN}")
    if "curve" in values:
        values["curve"] = _unpacked(values["curve"], where)
    return _parse(values, where)


def settings_hash(settings: Mapping[str, Any]) -> str:
    """Hash what was trained: the settings of `Result.schedule`, by dotted name."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()


def run_id(config_hash: str, data_hash: str, seed: int) -> str:
    """Make the id of a run from what it is a run of."""
    return hashlib.sha256(f"{config_hash} {data_hash} {seed}".encode()).hexdigest()[:12]


def _packed(curve: Sequence[Mapping[str, Any]]) -> list[dict[str, list[Any]]]:
    """Put the points of a curve into tables of columns, one for each set of values that they have."""
    tables: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    for point in curve:
        tables.setdefault(tuple(point), []).append(point)
    return [{name: [point[name] for point in points] for name in names} for names, points in tables.items()]


def _unpacked(tables: Any, where: str) -> list[dict[str, Any]]:
    if not isinstance(tables, list):
        raise PopError(f"{where}: curve is {json.dumps(tables)[:60]}; it must be a list of tables; {_AGAIN}")
    points: list[dict[str, Any]] = []
    for i, table in enumerate(tables):
        columns = list(table.values()) if isinstance(table, dict) else []
        if not columns or not all(isinstance(c, list) and len(c) == len(columns[0]) for c in columns):
            raise PopError(f"{where}: curve[{i}] must be an object of lists of one length; {_AGAIN}")
        if "step" not in table or not all(_finite(step) for step in table["step"]):
            raise PopError(f"{where}: curve[{i}]: step must be a list of numbers; {_AGAIN}")
        points += [dict(zip(table, values, strict=True)) for values in zip(*columns, strict=True)]
    return sorted(points, key=lambda point: point["step"])


class _Fields:
    """The fields of one result, each taken with a check; errors name file and field."""

    def __init__(self, found: Mapping[str, Any], where: str) -> None:
        self.found, self.where = found, where

    def fail(self, field: str, must: str) -> PopError:
        shown = json.dumps(self.found.get(field), default=str)
        return PopError(f"{self.where}: {field} is {shown[:60]}; it must be {must}")

    def text(self, field: str, pattern: str = r".+", must: str = "a text", or_none: bool = False) -> Any:
        value = self.found[field]
        if value is None and or_none:
            return None
        if not isinstance(value, str) or not re.fullmatch(pattern, value):
            raise self.fail(field, must)
        return value

    def whole(self, field: str, least: int) -> int:
        value = self.found[field]
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            raise self.fail(field, f"a whole number of at least {least}")
        return value

    def number(self, field: str, least: float, most: float = math.inf) -> float:
        value = self.found[field]
        if not _finite(value) or not least <= value <= most:
            low, high = math.isfinite(least), math.isfinite(most)
            between = f" from {least:g} to {most:g}" if low and high else f" of at least {least:g}" if low else ""
            raise self.fail(field, f"a finite number{between}")
        return float(value)

    def number_or_none(self, field: str) -> float | None:
        return None if self.found[field] is None else self.number(field, 0.0)

    def mapping(self, field: str) -> dict[str, Any]:
        value = self.found[field]
        if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
            raise self.fail(field, "an object")
        return dict(value)

    def inner(self, field: str) -> _Fields:
        return _Fields(self.mapping(field), f"{self.where}: {field}")


def _finite(value: Any) -> bool:
    # a whole number may be too large for a float
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _known(found: Mapping[str, Any], names: Iterable[str], where: str) -> None:
    wanted = list(names)
    for name in wanted:
        if name not in found:
            raise PopError(f"{where}: {name} is absent; {_AGAIN}")
    for name in found:
        if name not in wanted:
            raise PopError(f"{where}: {name} is not a field of a result; the fields are {', '.join(wanted)}")


def _parse(found: Mapping[str, Any], where: str) -> Result:
    _known(found, [_KEYS.get(f.name, f.name) for f in fields(Result)], where)
    take = _Fields(found, where)
    result = _result(take)
    _agree(result, take)
    return result


def _result(take: _Fields) -> Result:
    if take.text("scale") not in SCALES:
        raise take.fail("scale", f"one of {', '.join(SCALES)}")
    name = r"[a-z0-9]+(?:_[a-z0-9]+)*"
    lower = "lower-case letters, digits and _"
    n, files = take.whole("num_gaussians", 0), take.inner("files")
    return Result(
        scale=take.text("scale"),
        row=take.text("row", name, lower),
        scene=take.text("scene", name, lower),
        seed=take.whole("seed", 0),
        run=take.text("run", *_RUN),
        commit=take.text("commit", COMMIT, "a git commit or null", or_none=True),
        config_hash=take.text("config_hash", *_HASH),
        data_hash=take.text("data_hash", *_HASH),
        machine=take.text("machine"),
        cpu=take.text("cpu", or_none=True),
        engine=take.text("engine"),
        threads=take.whole("threads", 1),
        versions=take.mapping("versions"),
        protocol=_protocol(take.inner("protocol")),
        schedule=_schedule(take.inner("schedule")),
        seconds=_seconds(take.inner("seconds")),
        num_gaussians=n,
        checkpoint_mib=take.number("checkpoint_mib", 0.0),
        psnr=take.number("psnr", -100.0, 200.0),
        ssim=take.number("ssim", -1.0, 1.0),
        lpips=_lpips(take),
        lpips_reason=take.text("lpips_reason", or_none=True),
        n_blended=take.number_or_none("n_blended"),
        n_traversed=take.number_or_none("n_traversed"),
        opacity_below_01=take.number("opacity_below_0.1", 0.0, 1.0),
        opacity_above_09=take.number("opacity_above_0.9", 0.0, 1.0),
        opacity_histogram=_histogram(take, n),
        curve=_curve(take),
        per_view=_per_view(take.inner("per_view")),
        ply_hash=take.text("ply_hash", *_HASH, or_none=True),
        files={name: files.text(name, *_HASH) for name in files.found},
    )


def _agree(result: Result, take: _Fields) -> None:
    """Refuse a result whose fields do not agree with each other, naming the one that is not what the others say."""
    n, settings, protocol = result.num_gaussians, result.schedule, result.protocol
    size, last = protocol["checkpoint_bytes_per_gaussian"], settings["max_steps"] - 1
    views, edge = list(result.per_view.values()), BINS // 10
    due = {
        "config_hash": (settings_hash(settings), "the hash of the settings in schedule"),
        "run": (run_id(result.config_hash, result.data_hash, result.seed), "what config_hash, data_hash and seed give"),
        "checkpoint_mib": (n * size / 2**20, f"{n} Gaussians of {size} bytes"),
    }
    for field, (value, of_what) in due.items():
        if getattr(result, field) != value:
            raise take.fail(field, f"{value}, {of_what}; {_AGAIN}")
    measured = {
        **{name: (sum(view[name] for view in views) / max(len(views), 1), 1e-9) for name in ("psnr", "ssim")},
        "opacity_below_0.1": (sum(result.opacity_histogram[:edge]) / max(n, 1), 0.5 / max(n, 1)),
        "opacity_above_0.9": (sum(result.opacity_histogram[-edge:]) / max(n, 1), 0.5 / max(n, 1)),
    }
    for field, (value, within) in measured.items():
        if abs(take.found[field] - value) > within:
            raise take.fail(field, f"{value}, by {'opacity_histogram' if 'opacity' in field else 'per_view'}; {_AGAIN}")
    of_protocol = take.inner("protocol")
    for field, value in (("test_views", len(views)), ("factor", settings.get("factor"))):
        if protocol[field] != value:
            raise of_protocol.fail(field, f"{value}, by {'per_view' if field == 'test_views' else 'schedule'}")
    if result.curve and (result.curve[-1]["step"], result.curve[-1]["num_gaussians"]) != (last, n):
        raise take.fail("curve", f"one that ends at step {last}, of schedule, with {n} Gaussians")


def _protocol(take: _Fields) -> dict[str, Any]:
    further = [name for name in _OF_FIRST_STEPS if name in take.found]
    _known(take.found, [*_PROTOCOL, *further], take.where)
    for name in further:
        take.text(name, *_OF_FIRST_STEPS[name])
    for name, kind in _PROTOCOL.items():
        _ = take.text(name) if kind is str else take.whole(name, 1)
    return dict(take.found)


def _schedule(take: _Fields) -> dict[str, Any]:
    if "max_steps" not in take.found:
        raise take.fail("max_steps", "there, a whole number of at least 1")
    _ = take.whole("max_steps", 1)
    return dict(take.found)


def _seconds(take: _Fields) -> dict[str, float]:
    counted = [*_PHASES, *(["cpu"] if "cpu" in take.found else [])]
    _known(take.found, counted, take.where)
    return {phase: take.number(phase, 0.0) for phase in counted}


def _lpips(take: _Fields) -> dict[str, float | None]:
    inner = take.inner("lpips")
    _known(inner.found, LPIPS_VARIANTS, inner.where)
    values = {variant: inner.number_or_none(variant) for variant in LPIPS_VARIANTS}
    if None in values.values() and take.found["lpips_reason"] is None:
        raise take.fail("lpips_reason", "a text, since a variant of LPIPS is null")
    return values


def _histogram(take: _Fields, n: int) -> tuple[int, ...]:
    value = take.found["opacity_histogram"]
    counts = isinstance(value, list | tuple) and all(isinstance(c, int) and c >= 0 for c in value)
    if not counts or len(value) != BINS or sum(value) != n:
        raise take.fail("opacity_histogram", f"{BINS} counts whose sum is num_gaussians, {n}")
    return tuple(value)


def _curve(take: _Fields) -> tuple[dict[str, Any], ...]:
    value, last = take.found["curve"], -1
    if not isinstance(value, list | tuple) or not all(isinstance(point, Mapping) for point in value):
        raise take.fail("curve", "a list of objects")
    for i, point in enumerate(value):
        inner = _Fields(point, f"{take.where}: curve[{i}]")
        for name in ("step", "num_gaussians"):
            if name not in point:
                raise PopError(f"{inner.where}: {name} is absent; {_AGAIN}")
        last = inner.whole("step", last + 1)
        inner.whole("num_gaussians", 0)
        for name in point:
            inner.number(name, -math.inf)
    return tuple(dict(point) for point in value)


def _per_view(take: _Fields) -> dict[str, dict[str, float]]:
    views = {}
    for name in take.found:
        view = take.inner(name)
        _known(view.found, ("psnr", "ssim"), view.where)
        views[name] = {"psnr": view.number("psnr", -100.0, 200.0), "ssim": view.number("ssim", -1.0, 1.0)}
    return views


def home(package: Path) -> Path:
    """Return the folder of results and work: the package's own in a clone, else `paper_repro` of the current folder."""
    # pip neither installs nor keeps what a command would write between the files of a package
    return package if (package.parent / "pyproject.toml").is_file() else Path("paper_repro").absolute()


HOME: Final = home(Path(__file__).resolve().parent)
RESULTS: Final = HOME / "results"
# what a line begins with, by which it is known without its curve
_HEAD: Final = re.compile(
    rf'\{{"schema":{SCHEMA},"scale":"(\w+)","row":"(\w+)","scene":"(\w+)","seed":(\d+),', flags=re.ASCII
)


def path_of(scale: str, row: str, folder: Path = RESULTS) -> Path:
    """Give the file of a row's results in a folder of results."""
    return folder / scale / f"{row}.jsonl"


def existing_folder(folder: Path) -> Path:
    """Return a folder of results that is to be read; the default one may be absent, as it is where nothing was trained.

    Raises:
        PopError: it is not there: a name that was typed wrong would else be a folder without results.
    """
    if folder != RESULTS and not folder.is_dir():
        raise PopError(f"{folder}: no such folder; name the one that holds the results with --results")
    return folder


def kept(scale: str, row: str, folder: Path = RESULTS) -> frozenset[tuple[str, int]]:
    """List the scenes and seeds of which a row has a result; their values are not looked at.

    Raises:
        PopError: the file holds something else than results of the row, or two of one scene and seed.
    """
    return frozenset(_lines(path_of(scale, row, folder)))


def find(scale: str, row: str, scene: str, seed: int, folder: Path = RESULTS) -> Result | None:
    """Read one result, or return None where there is none.

    Raises:
        PopError: as `read`, for this result.
    """
    path = path_of(scale, row, folder)
    number, line = _lines(path).get((scene, seed), (0, None))
    return None if line is None else from_line(line, f"{path}: line {number}")


def read(path: Path) -> tuple[Result, ...]:
    """Read a row's results, by scene and seed.

    Raises:
        PopError: the file cannot be read, or a line is not a result, not one of this row and scale, or not what its
            own fields say; names the line and the field.
    """
    lines = _lines(path)
    return tuple(from_line(line, f"{path}: line {number}") for _, (number, line) in sorted(lines.items()))


def read_all(scale: str, folder: Path = RESULTS) -> tuple[Result, ...]:
    """Read every result of a scale, by row, scene and seed; none is fine.

    Raises:
        PopError: the scale is unknown, or as `read`.
    """
    return tuple(result for path in sorted((folder / scale_named(scale).name).glob("*.jsonl")) for result in read(path))


def write(result: Result, folder: Path = RESULTS) -> Path:
    """Put a result into its row's file, in place of an older one of its scene and seed, and return the file.

    Raises:
        PopError: a field is not what it must be, or the file is damaged or cannot be written.
    """
    path, line = path_of(result.scale, result.row, folder), to_line(result)
    with _alone(path.parent):
        lines = {key: text for key, (_, text) in _lines(path).items()} | {(result.scene, result.seed): line}
        write_file(path, "".join(f"{lines[key]}\n" for key in sorted(lines)))
    return path


def _lines(path: Path) -> dict[tuple[str, int], tuple[int, str]]:
    """Read the lines of a file by scene and seed, each with its number; none where the file is absent."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError) as error:
        raise PopError(f"{path}: cannot be read ({error})") from None
    lines: dict[tuple[str, int], tuple[int, str]] = {}
    for number, line in enumerate(text.split("\n"), 1):
        if not line:
            continue
        head = _HEAD.match(line)
        if head is None:
            raise PopError(
                f"{path}: line {number}: must begin with schema {SCHEMA}, scale, row, scene and seed, and begins with "
                f"{line[:60]!r}; remove the line and train its row again"
            )
        scale, row, scene, seed = head.groups()
        if (scale, row) != (path.parent.name, path.stem):
            raise PopError(f"{path}: line {number}: is of {row} at scale {scale}; its place is {scale}/{row}.jsonl")
        key = scene, int(seed)
        if key in lines:
            raise PopError(f"{path}: lines {lines[key][0]} and {number} are both of {scene}, seed {seed}; remove one")
        lines[key] = number, line
    return lines


def check_writable(folder: Path) -> None:
    """Refuse a folder that no result could be written into, before the days of training."""
    with _alone(folder):
        if not os.access(folder, os.W_OK):
            raise PopError(f"{folder}: cannot be written to; change its mode, or choose another folder")


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, waiting for another process that writes there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise PopError(f"{folder}: cannot be written to ({error.strerror}); choose another folder") from None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        # the lock ends with the handle
        os.close(handle)
