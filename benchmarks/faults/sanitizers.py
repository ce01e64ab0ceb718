"""Every unit of C++ under sanitizers: of the compiled backend and of the kernels' emulator.

Two libraries are made of the compiled backend, one for AddressSanitizer and UndefinedBehaviorSanitizer, one for
ThreadSanitizer. The first also counts which lines ran, so that a unit that nothing calls is a failure. Each is used by
a child, which is this module run by its name.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch

import cuda_ext
import pop_fast.compiled
from benchmarks.record import lines_run
from cuda_ext.host import emulate
from cuda_ext.toolkit import find_compiler
from pop_fast import rasterization
from pop_fast.api.backends import COMPILED
from pop_fast.children import module_command
from pop_fast.compiled import build, library
from pop_fast.compiled.build import CUDA, HERE, SHARED, SOURCES, UNITS
from pop_fast.compiled.native_step import NativeTrainer
from pop_fast.data.capture import Capture
from pop_fast.data.load import load_capture
from pop_fast.stages.stage_set import PassInput
from pop_fast.stages.types import Camera, Gaussians
from pop_fast.train import TrainConfig, TrainingRun
from pop_ref.conformance.corpus import PLANS, corpus_scene
from pop_ref.constants import PAPER

from .corpus import HERE as CORPUS

ROOT = Path(__file__).resolve().parents[2]
CUDA_EXT = Path(cuda_ext.__file__).resolve().parent
_MEMORY: Final = ("-fsanitize=address,undefined", "-fno-sanitize-recover=undefined")
_COUNTED: Final = ("--coverage", "-fprofile-update=atomic")
_FLAGS: Final = ("-std=c++17", "-O1", "-g1", "-fno-omit-frame-pointer", "-fPIC", "-shared", "-pthread")
# of a unit's own lines, which are doors to what its headers hold
LEAST_SHARE: Final = 0.5


@dataclass(frozen=True)
class Check:
    """A library under sanitizers, and the tests that use it."""

    units: tuple[Path, ...]  # what it is made of
    sources: tuple[Path, ...]  # all that its text depends on
    flags: tuple[str, ...]  # of the compiler
    runtime: str  # the sanitizers' library, which must be loaded before all others
    use: str  # what the child does with it, told the library by `POP_SANITIZED`
    about: str  # the sanitizers, in words

    @property
    def library(self) -> Path:
        """Where it is kept, in the checkout, whether or not it has been compiled."""
        digest = hashlib.sha256(" ".join(self.flags).encode())
        for path in self.sources:
            digest.update(path.read_bytes())
        return ROOT / "out" / "faults" / digest.hexdigest()[:16] / "kernels.so"


_COMPILED: Final = tuple(HERE / unit for unit in UNITS)
_OF_COMPILED: Final = (*(HERE / name for name in SOURCES), *(CUDA / name for name in SHARED))
_TUNED: Final = (*_FLAGS, "-march=native", f"-I{CUDA.parent}")
_ADDRESS: Final = "AddressSanitizer and UndefinedBehaviorSanitizer"
CHECKS: Final[Mapping[str, Check]] = {
    "compiled backend": Check(
        _COMPILED, _OF_COMPILED, (*_TUNED, *_MEMORY, *_COUNTED), "libasan.so", "compiled", _ADDRESS
    ),
    "compiled backend, four threads": Check(
        _COMPILED, _OF_COMPILED, (*_TUNED, "-fsanitize=thread"), "libtsan.so", "threads", "ThreadSanitizer"
    ),
}
EMULATION: Final = "kernels under the emulator"
# these are compiled by the emulator's own build, with the flags that POP_EMULATED_FLAGS adds
EMULATED: Final = (emulate.HERE / "emulator.cpp", CUDA_EXT / "bindings.cpp")
# its fibers switch stacks, which AddressSanitizer must not follow
_EMULATED_FLAGS: Final = "-fsanitize=address --param asan-stack=0"
_EMULATED_TESTS: Final = "tests/cuda/gpu/test_ten_steps.py"
# that the native step knows, and whose passes call every function of scores.cpp between them
METHODS = ("pop", "gsplat", "3dgs", "taming", "pup", "mini-splatting", "speedy-splat")
# Python keeps what it has, and asks for much at once
_OPTIONS: Final = {
    "ASAN_OPTIONS": "detect_leaks=0:allocator_may_return_null=1",
    "UBSAN_OPTIONS": "print_stacktrace=1:halt_on_error=1",
    "TSAN_OPTIONS": "halt_on_error=1:exitcode=66:report_signal_unsafe=0:ignore_noninstrumented_modules=1",
}


def units() -> list[Path]:
    """List every unit of C++ that the package and its host build are made of."""
    found = (*HERE.glob("*.cpp"), *CUDA_EXT.rglob("*.cpp"))
    return sorted(path for path in found if "build" not in path.relative_to(ROOT).parts)


def uncovered() -> list[str]:
    """List the units that no check is made of."""
    covered = {*(unit for check in CHECKS.values() for unit in check.units), *EMULATED}
    return [str(path.relative_to(ROOT)) for path in units() if path not in covered]


def why_not(check: Check) -> str | None:
    """Say why a library cannot be compiled here, or None."""
    compiler = find_compiler()
    if compiler is None:
        return "there is no C++ compiler"
    return None if _runtime(compiler, check.runtime) else f"{compiler[0]} has no {check.runtime}"


def _runtime(compiler: list[str], name: str) -> str | None:
    asked = [*compiler, f"-print-file-name={name}"]
    path = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()
    return path if os.path.isabs(path) else None


def sanitized(compile_first: bool = True) -> dict[str, Any]:
    """Use every library in a child of its own.

    Args:
        compile_first: compile what is not there, which takes minutes; if not, those are left out, and named.
    """
    checks = {name: _checked(check, compile_first) for name, check in CHECKS.items()}
    checks[EMULATION] = _emulated(compile_first)
    lines = {name: share for check in checks.values() for name, share in check.pop("lines", {}).items()}
    failures = [f"{name}: {line}" for name, check in checks.items() for line in check["failures"]]
    failures += [f"{name}: no check compiles it" for name in uncovered()]
    failures += [f"{name}: {run} of {of} lines ran" for name, (run, of) in lines.items() if run < LEAST_SHARE * of]
    return {"checks": checks, "lines": lines, "failures": failures}


def _checked(check: Check, compile_first: bool) -> dict[str, Any]:
    reason, target = why_not(check), check.library
    if reason is None and not target.exists() and not compile_first:
        reason = f"{target.parent.name} is not compiled"
    if reason is not None:
        return {"about": check.about, "skipped": reason, "failures": []}
    compiler = find_compiler() or []
    if not target.exists():
        _compile(compiler, check)
    for counts in target.parent.glob("*.gcda"):
        counts.unlink()
    words = module_command("benchmarks.faults.sanitizers", check.use)
    told, failures = _ran(words, check, compiler, {"POP_SANITIZED": str(target)})
    return {"about": check.about, "told": told, "lines": _lines(check), "failures": failures}


def _ran(words: list[str], check: Check, compiler: list[str], more: dict[str, str]) -> tuple[list[str], list[str]]:
    """Return what a child printed, and its failure, if it was one."""
    runtime = str(_runtime(compiler, check.runtime))
    environment = {**os.environ, **_OPTIONS, **more, "LD_PRELOAD": runtime, "PYTHONPATH": str(ROOT)}
    # the kernel lays memory out more freely than ThreadSanitizer of this age expects
    fixed = ["setarch", "-R"] if check.runtime == "libtsan.so" and shutil.which("setarch") else []
    done = subprocess.run([*fixed, *words], env=environment, capture_output=True, text=True, check=False, cwd=ROOT)
    failures = [] if done.returncode == 0 else [f"status {done.returncode}: {(done.stderr or done.stdout)[:3000]}"]
    return done.stdout.split("\n")[:-1], failures


def _compile(compiler: list[str], check: Check) -> None:
    folder = check.library.parent
    folder.mkdir(parents=True, exist_ok=True)
    made = folder / "making.so"
    command = [*compiler, *check.flags, "-o", str(made), *map(str, check.units)]
    # counters of lines are written where the compiler worked
    subprocess.run(command, check=True, capture_output=True, cwd=folder)
    os.replace(made, check.library)


def _lines(check: Check) -> dict[str, tuple[int, int]]:
    """Return how many lines of each unit ran, and of how many; nothing where they are not counted."""
    folder, program = check.library.parent, shutil.which("gcov")
    if program is None or "--coverage" not in check.flags:
        return {}
    found: dict[str, tuple[int, int]] = {}
    for unit in check.units:
        counted = [path.name for path in folder.glob(f"*-{unit.stem}.gcda")]
        lines = lines_run(program, folder, counted)
        ran = [run for (path, _), run in lines.items() if path.name == unit.name]
        found[str(unit.relative_to(ROOT))] = (sum(ran), len(ran)) if ran else (0, 1)
    return found


def _emulated(compile_first: bool) -> dict[str, Any]:
    """Run the kernels' own source, their bindings and the emulator through some of their tests."""
    about, reason = "AddressSanitizer", emulate.why_not()
    if reason is None and not compile_first:
        reason = "its build takes minutes"
    if reason is not None:
        return {"about": about, "skipped": reason, "failures": []}
    check, compiler = CHECKS["compiled backend"], find_compiler() or []
    words = module_command("pytest", "-q", "-p", "no:cacheprovider", _EMULATED_TESTS)
    told, failures = _ran(words, check, compiler, {"POP_EMULATED_FLAGS": _EMULATED_FLAGS, "POP_CUDA_ON": "emulated"})
    return {"about": about, "told": told[-1:], "failures": failures}


def main() -> None:
    """In a process of its own: put the library of `POP_SANITIZED` in the compiled one's place, and use all of it."""
    what, path = sys.argv[1], Path(os.environ["POP_SANITIZED"])
    _use(path, threads=4 if what == "threads" else 2, steps=24 if what == "threads" else 40)
    loaded = Path("/proc/self/maps").read_text()
    if str(path) not in loaded or "/_blend_" in loaded:
        raise SystemExit("another library than the sanitized one was used")


def _use(path: Path, threads: int, steps: int) -> None:
    build.library_path = library.library_path = lambda: path
    # threads of torch's OpenMP wait for one another where no sanitizer sees it: those of the library are its own
    library._fork = lambda: None
    if pop_fast.compiled.why_not() is not None:
        raise SystemExit("the sanitized library is not loaded")
    torch.set_num_threads(threads)
    drawn = sum(_draw(name, dtype) for name in PLANS for dtype in (torch.float32, torch.float64))
    print(f"{drawn} renders with gradients and all passes")
    capture = load_capture(str(CORPUS / "colmap"))
    print(f"{sum(_train(capture, method, threads, steps) for method in METHODS)} training steps in C++")


def _train(capture: Capture, method: str, threads: int, steps: int) -> int:
    plan = {"refine_start_iter": 2, "refine_every": 5, "grow_grad2d": 1e-6}
    config = TrainConfig.of(
        method=method,
        preset="paper",
        steps_scaler=steps / 30_000,
        backend="compiled",
        threads=threads,
        ssim_padding="same",
        test_every=3,
        progress=False,
        **{f"{method}.{name}": value for name, value in plan.items()},
    )
    run = TrainingRun(config, capture)
    while run.step < config.max_steps:
        run.take_steps(run.step + 1)
    fused = getattr(run.stepper, "fused", None)
    if not isinstance(fused, NativeTrainer):
        raise SystemExit(f"{method} was not trained by the native step")
    if method == "pop" and not fused.counts()["entries"]:
        raise SystemExit("the last step had nothing to do")
    return run.step


def _draw(name: str, dtype: torch.dtype) -> int:
    scene = corpus_scene(name)
    gaussians, camera = scene.gaussians, scene.camera

    def tensor(array: object) -> torch.Tensor:
        return torch.as_tensor(array, dtype=dtype)

    inputs = [
        tensor(getattr(gaussians, key)).requires_grad_() for key in ("means", "quats", "scales", "opacities", "sh")
    ]
    degree = int(gaussians.sh.shape[1] ** 0.5) - 1
    image, alpha, _ = rasterization(
        **dict(zip(("means", "quats", "scales", "opacities", "colors"), inputs, strict=True)),
        viewmats=tensor(camera.viewmat)[None],
        Ks=tensor(camera.K)[None],
        width=camera.width,
        height=camera.height,
        sh_degree=degree,
        backend="compiled",
        packed=False,
        dominance=True,
    )
    (image.square().sum() + alpha.sum()).backward()
    if not all(torch.isfinite(one.grad).all() for one in inputs if one.grad is not None):
        raise SystemExit(f"{name}: a gradient is not finite")
    view = Camera(tensor(camera.viewmat), tensor(camera.K), camera.width, camera.height)
    shot = PassInput(
        Gaussians(*(one.detach() for one in inputs)), view, degree, torch.zeros(3, dtype=dtype), PAPER, False
    )
    passes = COMPILED.open_view(shot)
    passes.contributions(None)
    passes.contributions(torch.ones((camera.height, camera.width), dtype=dtype))
    passes.sensitivities()
    passes.fisher_blocks()
    passes.dominant_points()
    return 1


if __name__ == "__main__":
    main()
