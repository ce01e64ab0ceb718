"""What no law reaches, from a logged run of all of them: `python -m pop_ref.conformance.law_coverage FILE`.

The laws are tried on the oracle, and where it lacks what they ask for on pop_fast; a law that neither can be asked is
left out. Logged are the lines of the oracle's functions that run, and the arguments of everything that is drawn.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, Final

import numpy as np
import pytest

from pop_ref.conformance.adapter import STAGE_MODULES, Adapter, OracleAdapter
from pop_ref.conformance.backends import shipped
from pop_ref.conformance.calls import Call
from pop_ref.conformance.files import write_file
from pop_ref.conformance.law import Law, missing
from pop_ref.conformance.mutants.trial import every_law, obeys
from pop_ref.conformance.scenes import Scene

EXAMPLES: Final = 25
PACKAGE: Final = Path(__file__).parents[1]
# what draws, what trains, and what the methods read
MODULES: Final = tuple(sorted({*STAGE_MODULES, "render", "splatting", "depth", "margins"}))
# by function: why no law reaches lines of it; a statement that refuses arguments needs none
REASONS: Final[dict[str, str]] = {
    "taming.py: taming_scores": "sums what laws of single views judge",
    "margins.py: nearest": "read by reports of failures",
    "margins.py: near_threshold": "read by reports of failures",
    "margins.py: pixel_margins": "an exponent under 0 needs a conic that rounding has made indefinite",
    "margins.py: extent_margins": "of numbers that have overflowed; no law draws a whole scene of them",
    "margins.py: _reaches": "an opacity of 1 reaches 3.329 standard deviations, the limit is 3.33",
    "margins.py: safe_pixels": "read by reports of failures",
    "selection.py: lowest_share": "of nobody; a test of the oracle asks for it",
    "short_training.py: _rows": "of a step that portable vectors begin with",
    "tight_tiles.py: accutile": "a box without an ellipse",
}
# by argument: why laws stop where they do
LIMITS: Final[dict[str, str]] = {
    "Gaussians": "the oracle is slow: larger scenes have recorded answers, up to 70,000",
    "width, px": "more than twelve bits number; larger pictures are more of the same tiles",
    "height, px": "as the width",
    "tile_size, px": "the largest that common kernels have",
    "cameras": "more than a warp of 32 threads",
    "batch entries": "entries do not mix; larger batches are more of the same",
    "channels": "more than four chunks of 32",
    "sh_degree": "degree 3 is the highest that is defined",
    "opacity": "an opacity is a probability",
    "standard deviation, world units": "0 is a point; what is larger covers every picture",
    "camera z, world units": "negative is behind the camera; the far plane's default is 1e10",
    "norm of a quaternion": "directions do not depend on it, and 0 has none",
    "focal length, px": "scales with the picture's size",
    "near_plane, world units": "none, the smallest default, one that culls, and both in scenes that are scaled",
    "far_plane, world units": "one that culls, the default, and both in scenes that are scaled",
    "eps2d, px^2": "none, and about the default, 0.3",
    "radius_clip, px": "0 leaves nobody out",
}


class Log:
    """What laws have reached.

    Attributes:
        lines: of each module of the oracle.
        ranges: the least and largest value by argument.
        choices: the values of arguments that have few.
    """

    def __init__(self) -> None:
        self.lines: dict[str, set[int]] = {f"{name}.py": set() for name in MODULES}
        self.ranges: dict[str, tuple[float, float]] = {}
        self.choices: dict[str, set[str]] = {}
        self._files = {str(PACKAGE / file): file for file in self.lines}
        self._left: dict[CodeType, set[int]] = {}

    def __enter__(self) -> Log:
        sys.settrace(self._entered)
        return self

    def __exit__(self, *_: object) -> None:
        sys.settrace(None)

    def _entered(self, frame: FrameType, event: str, arg: object) -> Any:
        file = self._files.get(frame.f_code.co_filename)
        if file is None:
            return None
        left = self._left.setdefault(frame.f_code, {line for _, _, line in frame.f_code.co_lines() if line})
        seen = self.lines[file]

        def line(frame: FrameType, event: str, arg: object) -> Any:
            seen.add(frame.f_lineno)
            left.discard(frame.f_lineno)
            return line if left else None

        # the line of the def is reached by the call
        left.discard(frame.f_lineno)
        seen.add(frame.f_lineno)
        return line if left else None

    def range(self, name: str, values: Any) -> None:
        """Note numbers of an argument."""
        values = np.asarray(values, dtype=np.float64)
        if values.size:
            low, high = self.ranges.get(name, (np.inf, -np.inf))
            self.ranges[name] = (min(low, float(np.min(values))), max(high, float(np.max(values))))

    def choice(self, name: str, value: Any) -> None:
        """Note a value of an argument that has few."""
        self.choices.setdefault(name, set()).add(str(value))

    def scene(self, scene: Scene) -> None:
        """Note what is drawn."""
        g, camera, profile = scene.gaussians, scene.camera, scene.profile
        self.range("Gaussians", len(g))
        self.range("width, px", camera.width)
        self.range("height, px", camera.height)
        self.range("tile_size, px", scene.side)
        self.range("sh_degree", scene.degree)
        self.range("opacity", g.opacities)
        self.range("standard deviation, world units", g.scales)
        self.range("camera z, world units", g.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3])
        self.range("norm of a quaternion", np.linalg.norm(g.quats, axis=1))
        self.range("focal length, px", np.diag(camera.K)[:2])
        self.range("near_plane, world units", profile.near_plane)
        self.range("far_plane, world units", profile.far_plane)
        self.range("eps2d, px^2", profile.eps2d)
        self.choice("constants", profile.name)
        self.choice("antialiased", scene.antialiased)

    def call(self, call: Call) -> None:
        """Note what is asked."""
        for _, _, frame in call.each:
            self.scene(frame.scene.with_overrides(profile=call.profile))
            self.range("channels", frame.n_colors)
        self.range("cameras", len(call.frames[0]))
        self.range("batch entries", len(call.frames))
        self.range("radius_clip, px", call.radius_clip)
        for name in ("render_mode", "packed", "camera_colors", "covars", "no_background", "sparse_grad", "absgrad"):
            self.choice(name, getattr(call, name))


class Logged:
    """A backend that notes what it is asked to draw."""

    def __init__(self, backend: Adapter, log: Log) -> None:
        self._backend, self._log = backend, log

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def render(self, scene: Scene) -> Any:
        self._log.scene(scene)
        return self._backend.render(scene)

    def plainly(self, scene: Scene) -> Any:
        self._log.scene(scene)
        return self._backend.plainly(scene)

    def gradients(self, scene: Scene, *cotangents: Any) -> Any:
        self._log.scene(scene)
        return self._backend.gradients(scene, *cotangents)

    def call(self, call: Call, *cotangents: Any) -> Any:
        self._log.call(call)
        return self._backend.call(call, *cotangents)  # type: ignore[attr-defined]


def run(examples: int = EXAMPLES) -> dict[str, Any]:
    """Try every law and return what was reached, as the file holds it.

    Raises:
        AssertionError: a law breaks.
    """
    log, backends = Log(), (OracleAdapter(), shipped("fast64"))
    with log:
        for path, stated in every_law().items():
            broken = _tried(stated, [each for each in backends if not missing(each, stated.needs)], log, examples)
            assert broken is None, f"{path}: {broken}"
    return {
        "examples": examples,
        "modules": {file: _lines(file, seen) for file, seen in log.lines.items()},
        # JSON has no infinity
        "ranges": {name: [x if np.isfinite(x) else None for x in log.ranges[name]] for name in sorted(log.ranges)},
        "choices": {name: sorted(log.choices[name]) for name in sorted(log.choices)},
    }


def _lines(file: str, seen: set[int]) -> dict[str, Any]:
    every = list(code_lines(file))
    unreached = [[name, text] for number, name, text in every if number not in seen]
    return {"sha256": digest_of(file), "lines": len(every), "unreached": unreached}


def _tried(stated: Law, able: list[Adapter], log: Log, examples: int) -> str | None:
    for backend in able:
        try:
            return obeys(stated, Logged(backend, log), examples)
        except pytest.skip.Exception:
            # it lacks what only an answer tells
            continue
    return None


def digest_of(file: str) -> str:
    """Return the digest of a module, by which it can be told that one has changed since a run."""
    return hashlib.sha256((PACKAGE / file).read_bytes()).hexdigest()


def code_lines(file: str) -> Iterator[tuple[int, str, str]]:
    """Yield number, function and text of every line of a module's functions that can run."""
    text = (PACKAGE / file).read_text(encoding="utf-8")
    rows = text.splitlines()
    found: dict[int, str] = {}
    # a class's body runs at the import, as a module's does
    waiting = list(_codes(compile(text, str(PACKAGE / file), "exec")))
    while waiting:
        code = waiting.pop()
        if code.co_flags & inspect.CO_OPTIMIZED:
            numbers = {line for _, _, line in code.co_lines() if line and line != code.co_firstlineno}
            found |= dict.fromkeys(numbers - found.keys(), code.co_name)
        waiting += _codes(code)
    yield from ((line, found[line], rows[line - 1].strip()) for line in sorted(found))


def _codes(code: CodeType) -> list[CodeType]:
    return [each for each in code.co_consts if isinstance(each, CodeType)]


def reason(file: str, function: str) -> str | None:
    """Return why no law reaches lines of a function; None where none is given."""
    return REASONS.get(f"{file}: {function}", REASONS.get(file))


def main(words: list[str]) -> int:
    """Write what a run reaches."""
    if len(words) != 1 or words[0].startswith("-"):
        print("usage: python -m pop_ref.conformance.law_coverage FILE")
        return 2
    write_file(Path(words[0]), json.dumps(run(), indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
