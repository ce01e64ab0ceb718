"""The compiled CPU kernels with AddressSanitizer and UndefinedBehaviorSanitizer, on the scenes that the laws keep."""

from __future__ import annotations

import hashlib
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from cuda_ext.compiler import find_compiler
from pop_fast.children import module_command
from pop_fast.compiled.build import CUDA, HERE, SHARED, SOURCES, UNITS

_FLAGS = (
    *("-std=c++17", "-O1", "-g1", "-fno-omit-frame-pointer", "-fsanitize=address,undefined", "-fPIC", "-shared"),
    *("-fno-sanitize-recover=undefined", "-pthread", "-march=native"),
)
ROOT = Path(__file__).resolve().parents[2]


def library() -> Path:
    """Return where the library of this source is kept, in the checkout, whether or not it has been compiled."""
    digest = hashlib.sha256()
    for path in (*(HERE / name for name in SOURCES), *(CUDA / name for name in SHARED)):
        digest.update(path.read_bytes())
    return ROOT / "out" / "faults" / f"_sanitized_{digest.hexdigest()[:16]}.so"


def why_not() -> str | None:
    """Say why the kernels cannot be compiled with sanitizers here, or None."""
    compiler = find_compiler()
    if compiler is None:
        return "there is no C++ compiler"
    runtime = _runtime(compiler)
    return None if runtime else f"{compiler[0]} has no AddressSanitizer"


def _runtime(compiler: list[str]) -> str | None:
    """Return the library that must be loaded before all others, as the interpreter is not built with sanitizers."""
    asked = [*compiler, "-print-file-name=libasan.so"]
    found = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()
    return found if os.path.isabs(found) else None


def sanitized(compile_first: bool = True) -> dict[str, Any]:
    """Draw the kept scenes, go back, and train some steps, in a child with the sanitized library.

    Args:
        compile_first: compile it where it is not there, which takes about a minute.
    """
    reason = why_not()
    target = library()
    if reason is None and not target.exists() and not compile_first:
        reason = f"{target.name} is not compiled"
    if reason is not None:
        return {"skipped": reason, "failures": []}
    compiler = find_compiler() or []
    if not target.exists():
        _compile(compiler, target)
    environment = {
        **os.environ,
        "LD_PRELOAD": str(_runtime(compiler)),
        "ASAN_OPTIONS": "detect_leaks=0:allocator_may_return_null=1",
        "UBSAN_OPTIONS": "print_stacktrace=1:halt_on_error=1",
        "PYTHONPATH": str(ROOT),
        "POP_SANITIZED": str(target),
    }
    command = module_command("benchmarks.faults.sanitized_child")
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, cwd=ROOT)
    failures = [] if done.returncode == 0 else [f"status {done.returncode}: {done.stderr[:3000]}"]
    return {"compiler": compiler[0], "told": done.stdout.split("\n")[:-1], "failures": failures}


def _compile(compiler: list[str], target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        made = Path(folder) / target.name
        command = [*compiler, *_FLAGS, f"-I{CUDA.parent}", "-o", str(made), *(str(HERE / unit) for unit in UNITS)]
        subprocess.run(command, check=True, capture_output=True)
        os.replace(made, target)
