"""Time this checkout against another one, turn about in one process, so that a noisy machine is as noisy for both.

    git worktree add /tmp/before HEAD~1
    python benchmarks/ab_benchmark.py /tmp/before                    whole training steps and the blend, all cases
    python benchmarks/ab_benchmark.py /tmp/before --only blend --repeats 40

Each repeat runs one checkout and then the other, in changing order, and gives one ratio, this / other; what is reported
is the median of the ratios and their quartiles. Nothing is timed unless the two render the same image. A checkout from
before modules were moved is refused: what is timed is called by this checkout's names.
"""

from __future__ import annotations

import argparse
import importlib
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

HERE = Path(__file__).resolve().parent
PACKAGES = ("pop_fast", "pop_ref", "cuda_ext", *(path.stem for path in HERE.glob("*.py")))
SAME = 1e-4  # the largest difference of two images, of colours around 1

Times = tuple[float, ...]


class Checkout:
    """The package of one checkout, next to any other that is loaded already."""

    def __init__(self, root: Path) -> None:
        """Import from a checkout.

        Raises:
            SystemExit: there is no package in the folder, or its modules stand elsewhere than this checkout's.
        """
        if not (root / "pop_fast" / "__init__.py").exists():
            raise SystemExit(f"{root} has no pop_fast/__init__.py; give the root of a checkout")
        self.root, self._modules = root, dict[str, ModuleType]()
        with self.imports():
            try:
                self.run: Any = importlib.import_module("run")
            except ImportError as error:
                why = f"{error}; this benchmark times checkouts whose modules stand where its own do"
                raise SystemExit(f"{root} cannot be timed from here: {why}, so give a later commit") from error
            found = Path(str(importlib.import_module("pop_fast").__file__)).resolve()
        if root.resolve() not in found.parents:
            raise SystemExit(f"asked for pop_fast of {root}, but Python found {found}")

    @contextmanager
    def imports(self) -> Iterator[None]:
        """Let what is imported meanwhile, also by functions when they are called, be this checkout's."""
        _forget()
        sys.modules.update(self._modules)
        path, sys.path[:0] = list(sys.path), [str(self.root), str(HERE)]
        try:
            yield
        finally:
            sys.path[:] = path
            self._modules = _forget()

    def blend(self, name: str, tile: int, backend: str) -> tuple[Callable[[], Times], Callable[[], Tensor]]:
        """Return what times a forward and a backward of the blend of a case, and what renders it."""
        with self.imports():
            _, splats, composite = self.run.blend_of(self._case(name), tile, backend)

        def once() -> Times:
            with self.imports():
                start = time.perf_counter()
                image = composite().image
                middle = time.perf_counter()
                torch.autograd.grad(image, splats, torch.ones_like(image))
                return middle - start, time.perf_counter() - middle

        return once, lambda: composite().image.detach()

    def step(self, name: str, folder: str, backend: str) -> tuple[Callable[[], Times], Callable[[], Tensor]]:
        """Return what times a training step of a case, and what renders its first view."""
        with self.imports():
            case = self._case(name)
            training = self.run.run_of(case, folder, backend)
            first = self.run.first_view(training, self.run.capture_of(case)).image

        def once() -> Times:
            with self.imports():
                start = time.perf_counter()
                training.take_steps(training.step + 1)
                return (time.perf_counter() - start,)

        return once, lambda: first

    def _case(self, name: str) -> Any:
        return next(case for case in self.run.RASTER_CASES if case.name == name)


def _forget() -> dict[str, ModuleType]:
    """Take the packages' modules out of Python's table, so that the next import reads files, and return them."""
    return {name: sys.modules.pop(name) for name in list(sys.modules) if name.split(".")[0] in PACKAGES}


def compare(this: Any, other: Any, parts: tuple[str, ...], repeats: int) -> dict[str, Any]:
    """Run two timed calls turn about.

    Returns:
        For each part: medians in ms, and the median and quartiles of the ratios, this / other.

    Raises:
        SystemExit: they do not render the same.
    """
    difference = float((this[1]() - other[1]()).abs().max())
    if not difference <= SAME:
        raise SystemExit(f"the checkouts' images differ by {difference:.1e}, more than {SAME:.0e}; nothing was timed")
    times: tuple[list[Times], list[Times]] = ([], [])
    for _ in range(3):
        this[0]()
        other[0]()
    for turn in range(repeats):
        for which in (0, 1) if turn % 2 else (1, 0):
            times[which].append((this[0], other[0])[which]())
    found: dict[str, Any] = {}
    for i, part in enumerate(parts):
        mine, its = ([taken[i] for taken in of] for of in times)
        quartiles = np.quantile([a / b for a, b in zip(mine, its, strict=True)], (0.25, 0.5, 0.75)).tolist()
        found[part] = {
            "this_ms": 1e3 * statistics.median(mine),
            "other_ms": 1e3 * statistics.median(its),
            "ratio": quartiles[1],
            "ratio_quartiles": [quartiles[0], quartiles[2]],
        }
    return found


def main() -> None:
    """Compare, print, and write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path, help="root of the other checkout")
    parser.add_argument("--only", choices=("blend", "step"), default=None)
    parser.add_argument("--backend", choices=("fast", "compiled"), default="fast", help="of both checkouts")
    parser.add_argument("--repeats", type=int, default=25)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=Path, default=None, help="JSON file")
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    other, this = Checkout(given.other), Checkout(HERE.parent)
    this.run.keep_freed_memory()
    timed: dict[str, dict[str, Any]] = {}
    with this.run.reproducible(given.threads), tempfile.TemporaryDirectory() as folder:
        if given.only != "step":
            for case in this.run.RASTER_CASES:
                for tile in (16, 8):
                    pair = [checkout.blend(case.name, tile, given.backend) for checkout in (this, other)]
                    timed[f"blend {case.name}, {tile} px"] = compare(*pair, ("forward", "backward"), given.repeats)
        if given.only != "blend":
            for case in this.run.RASTER_CASES:
                folders = (f"{folder}/{case.name}", f"{folder}/{case.name}-")
                both = zip((this, other), folders, strict=True)
                pair = [checkout.step(case.name, where, given.backend) for checkout, where in both]
                timed[f"step {case.name}"] = compare(*pair, ("step",), given.repeats)
    for name, parts in timed.items():
        for part, found in parts.items():
            low, high = found["ratio_quartiles"]
            print(
                f"{name:28s} {part:9s} {found['other_ms']:7.1f} -> {found['this_ms']:7.1f} ms, "
                f"ratio {found['ratio']:.3f} ({low:.3f} to {high:.3f})"
            )
    if given.out:
        other_commit = this.run.commit(given.other)
        how = {"machine": this.run.machine(), "other_commit": other_commit, "backend": given.backend}
        found = {**how, "repeats": given.repeats, "timed": timed}
        this.run.write_json(given.out, found)


if __name__ == "__main__":
    main()
