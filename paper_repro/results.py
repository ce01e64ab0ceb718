"""One finished run as a JSON file: its fields, how it is read with errors that name file and field, and written.

A result lies at `<folder>/<scale>/<row>/<scene>_<seed>.json`. Tables, figures, claims and the status table are made
from these files and from paper.toml alone.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from pop_fast.errors import PopError
from pop_fast.io.atomic import write_atomically

__all__ = ["BINS", "LPIPS_VARIANTS", "RESULTS", "SCALES", "SCHEMA", "Result", "path_of", "read", "read_all", "write"]

SCHEMA: Final = 1
SCALES: Final = ("toy", "small", "no_floor", "full", "paper")
LPIPS_VARIANTS: Final = ("vgg_01", "alex_norm", "alex_01")
BINS: Final = 50  # of the opacity histogram over [0, 1]
RESULTS: Final = Path(__file__).resolve().parent / "results"

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
# and of one that took its first steps from another run: that run's id
_BASE: Final = "base"
_RUN: Final = (r"[0-9a-f]{12}", "twelve hex digits")


@dataclass(frozen=True)
class Result:
    """What one finished run says of itself.

    Attributes:
        scale: "toy", "small", "no_floor", "full" or "paper".
        row: the configuration, by the name of its file in `configs`.
        scene: the capture, by its name here ("fox", "bonsai_800", "kitchen", ...).
        seed: of every random number of the run.
        run: twelve hex digits of the hash of configuration, data and seed.
        commit: the git commit that ran, or None outside a clone.
        config_hash: of the configuration.
        data_hash: of the capture's files.
        machine: the processor, and after ", " the GPU where one was used.
        engine: the engine that trained.
        threads: CPU threads.
        versions: of Python and the packages that compute.
        protocol: split, images, size, metrics, timing, and the bytes of a Gaussian in a checkpoint; "base" is the id of
            the run that its first steps are from, whose time is in its own.
        schedule: the settings as they were run, by dotted name.
        seconds: by the clock, of "load", "train" and "evaluate"; "cpu" is the processor time of "train" over all
            threads, where a CPU trained and it was counted.
        num_gaussians: at the end.
        checkpoint_mib: size of the parameters in float32, MiB.
        psnr: dB, mean over the held-out views.
        ssim: mean over the held-out views.
        lpips: by variant; None where its weights were not given.
        lpips_reason: why a variant is None; None when none is.
        n_blended: Gaussians blended a pixel, mean over the held-out views; None where the engine does not count.
        n_traversed: list entries visited a pixel, likewise.
        opacity_below_01: share of Gaussians with opacity under 0.1 ("opacity_below_0.1" in the file).
        opacity_above_09: share of Gaussians with opacity over 0.9 ("opacity_above_0.9" in the file).
        opacity_histogram: counts in 50 equal bins over [0, 1].
        curve: what was logged during training, by rising "step"; absent values are None. What begins with "grad_" and
            "probe_" is of a few training views that are rendered all along, "psnr_test" of the held-out views.
        per_view: "psnr" and "ssim" of every held-out view, by its name.
    """

    scale: str
    row: str
    scene: str
    seed: int
    run: str
    commit: str | None
    config_hash: str
    data_hash: str
    machine: str
    engine: str
    threads: int
    versions: Mapping[str, Any]
    protocol: Mapping[str, Any]
    schedule: Mapping[str, Any]
    seconds: Mapping[str, float]
    num_gaussians: int
    checkpoint_mib: float
    psnr: float
    ssim: float
    lpips: Mapping[str, float | None]
    lpips_reason: str | None
    n_blended: float | None
    n_traversed: float | None
    opacity_below_01: float
    opacity_above_09: float
    opacity_histogram: tuple[int, ...]
    curve: tuple[Mapping[str, Any], ...]
    per_view: Mapping[str, Mapping[str, float]]

    @property
    def training_seconds(self) -> float:
        """What the training takes of a machine that does nothing else, as far as it is known, s.

        Processor time a thread where it was counted: the clock goes on through pauses and the work of others.
        """
        return self.seconds["cpu"] / self.threads if "cpu" in self.seconds else self.seconds["train"]

    @property
    def is_timed(self) -> bool:
        """Whether that can be compared: a CPU's by the clock cannot, since it may have done other work."""
        return "cpu" in self.seconds or ", " in self.machine

    @property
    def trained_on(self) -> str:
        """Say of the training time what it is a time of: machine, engine, threads."""
        return f"{self.machine}, {self.engine}, {self.threads} thread{'' if self.threads == 1 else 's'}"

    def at(self, step: int, key: str = "num_gaussians") -> float | None:
        """Give a value of the curve at a step, linearly between the logged ones; None outside of them."""
        known = [(int(p["step"]), float(p[key])) for p in self.curve if p.get(key) is not None]
        for (s0, v0), (s1, v1) in pairwise(known):
            if s0 <= step <= s1:
                return v0 + (v1 - v0) * (step - s0) / (s1 - s0)
        return known[0][1] if len(known) == 1 and known[0][0] == step else None


def path_of(result: Result, folder: Path = RESULTS) -> Path:
    """Give the place of a result in a folder of results."""
    return folder / result.scale / result.row / f"{result.scene}_{result.seed}.json"


def write(result: Result, folder: Path = RESULTS) -> Path:
    """Write a result to its place, whole or not at all, and return that place.

    Raises:
        PopError: a field is not what it must be, or the file cannot be written.
    """
    path = path_of(result, folder)
    values = {_KEYS.get(f.name, f.name): getattr(result, f.name) for f in fields(Result)}
    _parse(values, str(path))
    text = _text({"schema": SCHEMA, **values})
    write_atomically(path, lambda file: file.write(text.encode("utf-8")))
    return path


def read(path: str | Path) -> Result:
    """Read one result.

    Raises:
        PopError: no such file, not JSON, another schema, a field that is absent, unknown or wrong, or a file whose name
            says another scale, row, scene or seed than it holds.
    """
    path = Path(path)
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise PopError(f"{path}: cannot be read ({error.strerror}); make it with pop-repro run") from None
    except ValueError as error:
        raise PopError(f"{path}: is not JSON ({error}); run this row again") from None
    if not isinstance(found, dict):
        raise PopError(f"{path}: is {type(found).__name__}, not an object; run this row again")
    if found.pop("schema", None) != SCHEMA:
        raise PopError(f"{path}: schema must be {SCHEMA}; run this row again")
    result = _parse(found, str(path))
    if path.parts[-3:] != path_of(result).parts[-3:]:
        should = "/".join(path_of(result).parts[-3:])
        raise PopError(f"{path}: scale, row, scene and seed say that its place is {should}; move it there")
    return result


def read_all(scale: str, folder: Path = RESULTS) -> tuple[Result, ...]:
    """Read every result of a scale, by row, scene and seed; none is fine.

    Raises:
        PopError: the scale is unknown, or a file is not a result.
    """
    if scale not in SCALES:
        raise PopError(f"scale is '{scale}'; it must be one of {', '.join(SCALES)}")
    found = [read(path) for path in sorted((folder / scale).glob("*/*.json"))]
    return tuple(sorted(found, key=lambda r: (r.row, r.scene, r.seed)))


def _text(values: Mapping[str, Any]) -> str:
    # one field a line, one point of the curve a line: short, and a difference in git shows what changed
    lines = []
    for key, value in values.items():
        if key == "curve" and value:
            shown = "[\n  " + ",\n  ".join(json.dumps(point, allow_nan=False) for point in value) + "\n ]"
        else:
            shown = json.dumps(value, allow_nan=False)
        lines.append(f" {json.dumps(key)}: {shown}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


class _Fields:
    """The fields of one file, each taken with a check; errors name file and field."""

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
            between = f"from {least:g} to {most:g}" if math.isfinite(most) else f"of at least {least:g}"
            raise self.fail(field, f"a finite number {between}")
        return float(value)

    def number_or_none(self, field: str, least: float) -> float | None:
        return None if self.found[field] is None else self.number(field, least)

    def mapping(self, field: str) -> dict[str, Any]:
        value = self.found[field]
        if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
            raise self.fail(field, "an object")
        return dict(value)

    def inner(self, field: str) -> _Fields:
        return _Fields(self.mapping(field), f"{self.where}: {field}")


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _known(found: Mapping[str, Any], names: Iterable[str], where: str) -> None:
    wanted = list(names)
    for name in wanted:
        if name not in found:
            raise PopError(f"{where}: {name} is absent; run this row again")
    for name in found:
        if name not in wanted:
            raise PopError(f"{where}: {name} is not a field of a result; the fields are {', '.join(wanted)}")


def _parse(found: Mapping[str, Any], where: str) -> Result:
    _known(found, [_KEYS.get(f.name, f.name) for f in fields(Result)], where)
    take = _Fields(found, where)
    if take.text("scale") not in SCALES:
        raise take.fail("scale", f"one of {', '.join(SCALES)}")
    name = r"[a-z0-9]+(?:_[a-z0-9]+)*"
    lower = "lower-case letters, digits and _"
    n = take.whole("num_gaussians", 0)
    return Result(
        scale=take.text("scale"),
        row=take.text("row", name, lower),
        scene=take.text("scene", name, lower),
        seed=take.whole("seed", 0),
        run=take.text("run", *_RUN),
        commit=take.text("commit", r"[0-9a-f]{7,40}(?:-dirty)?", "a git commit or null", or_none=True),
        config_hash=take.text("config_hash", r"[0-9a-f]{12,64}", "a hash in hex digits"),
        data_hash=take.text("data_hash", r"[0-9a-f]{12,64}", "a hash in hex digits"),
        machine=take.text("machine"),
        engine=take.text("engine"),
        threads=take.whole("threads", 1),
        versions=take.mapping("versions"),
        protocol=_protocol(take.inner("protocol")),
        schedule=take.mapping("schedule"),
        seconds=_seconds(take.inner("seconds")),
        num_gaussians=n,
        checkpoint_mib=take.number("checkpoint_mib", 0.0),
        psnr=take.number("psnr", -100.0, 200.0),
        ssim=take.number("ssim", -1.0, 1.0),
        lpips=_lpips(take),
        lpips_reason=take.text("lpips_reason", or_none=True),
        n_blended=take.number_or_none("n_blended", 0.0),
        n_traversed=take.number_or_none("n_traversed", 0.0),
        opacity_below_01=take.number("opacity_below_0.1", 0.0, 1.0),
        opacity_above_09=take.number("opacity_above_0.9", 0.0, 1.0),
        opacity_histogram=_histogram(take, n),
        curve=_curve(take),
        per_view=_per_view(take.inner("per_view")),
    )


def _protocol(take: _Fields) -> dict[str, Any]:
    _known(take.found, [*_PROTOCOL, *([_BASE] if _BASE in take.found else [])], take.where)
    if _BASE in take.found:
        take.text(_BASE, *_RUN)
    for name, kind in _PROTOCOL.items():
        _ = take.text(name) if kind is str else take.whole(name, 1)
    return dict(take.found)


def _seconds(take: _Fields) -> dict[str, float]:
    counted = [*_PHASES, *(["cpu"] if "cpu" in take.found else [])]
    _known(take.found, counted, take.where)
    return {phase: take.number(phase, 0.0) for phase in counted}


def _lpips(take: _Fields) -> dict[str, float | None]:
    inner = take.inner("lpips")
    _known(inner.found, LPIPS_VARIANTS, inner.where)
    values = {variant: inner.number_or_none(variant, 0.0) for variant in LPIPS_VARIANTS}
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
                raise PopError(f"{inner.where}: {name} is absent; run this row again")
        last = inner.whole("step", last + 1)
        inner.whole("num_gaussians", 0)
        for name, item in point.items():
            if item is not None and not _finite(item):
                raise inner.fail(name, "a finite number or null")
    return tuple(dict(point) for point in value)


def _per_view(take: _Fields) -> dict[str, dict[str, float]]:
    views = {}
    for name in take.found:
        view = take.inner(name)
        _known(view.found, ("psnr", "ssim"), view.where)
        views[name] = {"psnr": view.number("psnr", -100.0, 200.0), "ssim": view.number("ssim", -1.0, 1.0)}
    return views
