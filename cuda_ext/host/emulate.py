"""Compile the kernels' own source for the host, launches, warps and barriers included, and put it in the GPU's place.

`kernel<<<grid, block, 0, stream>>>(arguments)` is turned into a call of the emulator; everything else is compiled as it
is, bindings included, against headers that stand in for CUDA's. Device pointers are then addresses of CPU tensors.

What is loaded from a library runs as whoever loads it. In a folder for everybody, such as that for temporary files,
whoever knows the name can put a library of their own there first: `library_folder` is next to the code, or in a cache
that is this user's alone.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import importlib.util
import os
import re
import shutil
import stat
import subprocess
import sys
import sysconfig
import types
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cuda_ext
from cuda_ext.toolkit import find_compiler

if TYPE_CHECKING:
    import pytest

HERE, CUDA_EXT = Path(__file__).parent, Path(cuda_ext.__file__).resolve().parent
# _setjmp and _longjmp switch fibers, which a fortified longjmp takes for an accident
FLAGS = ("-std=c++17", "-O1", "-fPIC", "-shared", "-ffp-contract=off", "-fno-strict-aliasing", "-U_FORTIFY_SOURCE")
# more flags: POP_EMULATED_FLAGS="-fsanitize=address --param asan-stack=0", with libasan preloaded, watches every access
FLAGS += tuple(os.environ.get("POP_EMULATED_FLAGS", "").split())
# its own domain: with the compiled extension in one process, its types are not taken for the extension's
FLAGS += ("-fvisibility=hidden", "-Wno-attributes", '-DPOP_CUDA_ARCHS="emulated"', "-DNB_DOMAIN=emulated")
_LAUNCH = re.compile(r"([A-Za-z_]\w*(?:<[\w\s,:]*>)?)\s*<<<")
# what the host asks and gets answered at once, also while a graph is captured
QUERIES = frozenset(
    {"tile_workspace", "loss_blocks", "important_blocks", "driver_version", "score_columns", "score_pitch"}
)


def why_not() -> str | None:
    """Return why the kernels cannot be emulated here, or None."""
    if not sys.platform.startswith("linux"):
        return "the emulator's fibers are written for Linux"
    if find_compiler() is None:
        return "no C++ compiler: the kernels cannot be emulated (install g++ or set CXX)"
    if importlib.util.find_spec("nanobind") is None:
        return "no nanobind: the kernels cannot be emulated (pip install nanobind)"
    return None


def translated(text: str) -> str:
    """Turn launches into calls of the emulator."""
    while match := _LAUNCH.search(text):
        end = text.index(">>>", match.end())
        grid, block, *_ = _split(text[match.end() : end])
        first = text.index("(", end)
        last = _closing(text, first)
        name = match.group(1).split("<")[0]
        call = f'::emulated::launch("{name}", ({grid}), ({block}), [&] {{ {match.group(1)}{text[first : last + 1]}; }})'
        text = text[: match.start()] + call + text[last + 1 :]
    return text


def _closing(text: str, first: int) -> int:
    depth = 0
    for k in range(first, len(text)):
        depth += (text[k] == "(") - (text[k] == ")")
        if depth == 0:
            return k
    raise ValueError("a launch without an end")


def _split(arguments: str) -> list[str]:
    parts, depth = [""], 0
    for letter in arguments:
        depth += (letter in "([{<") - (letter in ")]}>")
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


def build(folder: Path) -> Path:
    """Compile the emulated module into a folder, unless the same sources were compiled there before.

    It takes a minute: of several processes one compiles, and the others wait.
    """
    import fcntl  # not at the top: Windows has none

    import nanobind

    compiler = find_compiler()
    assert compiler is not None
    # not what was compiled before, which is below these folders
    kernels, stand_ins = (CUDA_EXT / "csrc").rglob("*"), (HERE / "include").rglob("*")
    there = [*CUDA_EXT.glob("*"), *kernels, HERE / "emulator.cpp", *stand_ins]
    files = sorted(file for file in there if file.suffix in (".cu", ".cuh", ".h", ".cpp"))
    digest = hashlib.sha256(" ".join((*compiler, sys.version, nanobind.__version__, *FLAGS)).encode())
    for file in files:
        digest.update(file.read_bytes())
    library = folder / f"emulated_{digest.hexdigest()[:16]}" / "_kernels.so"
    library.parent.mkdir(parents=True, exist_ok=True)
    with (library.parent / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not library.exists():
            _compile(compiler, library)
    return library


def _compile(compiler: list[str], library: Path) -> None:
    import nanobind

    work = library.parent / f"source_{os.getpid()}"
    (work / "csrc").mkdir(parents=True, exist_ok=True)
    for file in (CUDA_EXT / "csrc").iterdir():
        # .cpp, because the compiler goes by it
        (work / "csrc" / file.with_suffix(".cpp" if file.suffix == ".cu" else file.suffix).name).write_text(
            translated(file.read_text(encoding="utf-8")), encoding="utf-8"
        )
    shutil.copy(CUDA_EXT / "bindings.cpp", work)
    include = Path(nanobind.include_dir())
    folders = (HERE / "include", work, include, include.parent / "ext" / "robin_map" / "include")
    sources = (*work.rglob("*.cpp"), HERE / "emulator.cpp", Path(nanobind.source_dir()) / "nb_combined.cpp")
    flags = [*FLAGS, *(f"-I{path}" for path in (*folders, sysconfig.get_paths()["include"]))]
    partial = work / "_kernels.so"
    done = subprocess.run(
        [*compiler, *flags, *map(str, sources), "-o", str(partial)], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise RuntimeError(f"the kernels cannot be compiled for the host:\n{done.stderr[-4000:]}")
    partial.replace(library)
    shutil.rmtree(work)


class Kernels:
    """The emulated module, with a tape for what is asked of it while a graph is captured."""

    def __init__(self, module: types.ModuleType) -> None:
        self._module = module
        self.tape: list[Any] | None = None

    def __dir__(self) -> list[str]:
        return dir(self._module)

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._module, name)
        tape = self.tape
        if tape is None or not callable(found) or isinstance(found, type) or name in QUERIES:
            return found
        return lambda *arguments: tape.append((found, arguments))


def nodes(library: Path) -> dict[str, int]:
    """Return how many nodes of a graph what was launched since the last call would be, by their kernels' names."""
    ask = ctypes.CDLL(str(library)).emulated_nodes
    ask.restype = ctypes.c_char_p
    return {name: int(times) for name, times in (line.split() for line in ask().decode().splitlines())}


class NoWaiting:
    """In the place of `cuda_ext.training.train_step.Watch`: there is nothing to wait for."""

    def __init__(self, state: Any, depth: int) -> None:
        self._state, self._depth, self._posted = state, depth, []

    def __len__(self) -> int:
        return len(self._posted)

    def post(self) -> None:
        assert len(self._posted) < self._depth
        self._posted.append(self._state.tolist())

    def take(self) -> list[int]:
        return self._posted.pop(0)

    def clear(self) -> None:
        self._posted.clear()


@functools.cache
def loaded(library: Path) -> types.ModuleType:
    """Load the module, once in a process: its classes can be registered once only."""
    spec = importlib.util.spec_from_file_location("cuda_ext._kernels", library)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _rubbish(empty: Callable[..., Any]) -> Callable[..., Any]:
    """Fill what nobody has written with what nobody would: a kernel that reads it gives itself away."""

    def made(*arguments: Any, **options: Any) -> Any:
        tensor = empty(*arguments, **options)
        return tensor.fill_(float("nan") if tensor.is_floating_point() else 127)

    return made


def install(patch: pytest.MonkeyPatch, library: Path) -> None:
    """Put the emulated kernels where the GPU's would be, and the CPU where torch would find a GPU."""
    import torch

    from cuda_ext import arrays
    from cuda_ext.training import train_step

    kernels = Kernels(loaded(library))

    def captured(launch: Callable[[], None], device: Any) -> Callable[[], None]:
        tape: list[Any] = []
        kernels.tape = tape
        launch()
        kernels.tape = None

        def replayed() -> None:
            for function, arguments in tape:
                function(*arguments)

        return replayed

    patch.setitem(sys.modules, "cuda_ext._kernels", kernels)
    patch.setattr(cuda_ext, "why_not", lambda: None)
    patch.setattr(arrays, "on_gpu", lambda tensor: True)
    patch.setattr(torch.cuda, "current_stream", lambda device=None: types.SimpleNamespace(cuda_stream=0))
    patch.setattr(torch.cuda, "synchronize", lambda device=None: None)
    patch.setattr(torch.cuda, "mem_get_info", lambda device=None: (2**34, 2**34))
    patch.setattr(torch, "empty", _rubbish(torch.empty))
    patch.setattr(torch, "empty_like", _rubbish(torch.empty_like))
    patch.setattr(train_step, "Watch", NoWaiting)
    patch.setattr(train_step, "captured", captured)


def library_folder(package: Path = CUDA_EXT) -> Path:
    """Return the folder to compile into and to load from: `build` in the package's own, where that can be written to.

    Args:
        package: a folder with code of this project; whoever may write to it can change the code as well.

    Raises:
        RuntimeError: the cache that stands in for it is, or was, open to others; names it and what to do.
    """
    folder = package / "build"
    if os.access(folder if folder.exists() else package, os.W_OK):
        return folder
    given = os.environ.get("XDG_CACHE_HOME", "")
    cache = (Path(given) if os.path.isabs(given) else Path.home() / ".cache") / "pop-splatting"
    # made for this user alone from the first moment
    cache.parent.mkdir(parents=True, exist_ok=True)
    cache.mkdir(mode=0o700, exist_ok=True)
    _require_own(cache, others=0o077)
    for file in cache.iterdir():
        _require_own(file, others=0o022)
    return cache


def _require_own(path: Path, others: int) -> None:
    found = path.lstat()
    if stat.S_ISLNK(found.st_mode):
        problem = "is a link"
    elif found.st_uid != os.geteuid():
        problem = f"belongs to user {found.st_uid}, not to you"
    elif found.st_mode & others:
        problem = f"is open to others (mode {stat.S_IMODE(found.st_mode):03o})"
    else:
        return
    raise RuntimeError(f"{path}: {problem}, so nothing is loaded from it; remove it, or set XDG_CACHE_HOME elsewhere")
