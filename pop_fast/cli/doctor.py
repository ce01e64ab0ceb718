"""`pop doctor`: what is installed, what is missing and how to get it."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import importlib.util
import os
import platform
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Final, Literal

from pop_fast.api.backend import BACKENDS
from pop_fast.cli import parse
from pop_fast.machine import machine_name, memory_bytes

# holds all of torch that Python calls, and needs the rest of it
_LIBRARIES: Final = ("libtorch_python.so", "libtorch_python.dylib", "torch_python.dll")


def cuda_version() -> str | None:
    """Return the version of CUDA that torch was built with, None for a CPU build."""
    spec = importlib.util.spec_from_file_location("torch_version", _folder() / "version.py")
    if spec is None or spec.loader is None:
        raise ImportError("torch has no version.py")
    version = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(version)
    return version.cuda


def _folder() -> Path:
    spec = PathFinder.find_spec("torch")
    if spec is None or spec.origin is None:
        raise ImportError("torch is not where packages are installed")
    return Path(spec.origin).parent


def _loads() -> bool:
    try:
        (path,) = (path for name in _LIBRARIES if (path := _folder() / "lib" / name).exists())
        ctypes.CDLL(str(path))
    except (ImportError, ValueError, OSError):
        return False
    return True


State = Literal["ok", "missing", "off"]

# (distribution, module, what it is for, needed by pop itself)
_PACKAGES: Final = (
    ("numpy", "numpy", "arrays", True),
    ("scipy", "scipy", "nearest neighbours, camera paths", True),
    ("torch", "torch", "the fast path", True),
    ("opencv-contrib-python-headless", "cv2", "images, undistortion, video", True),
    ("pycolmap", "pycolmap", "COLMAP models, structure from motion", True),
    ("plyfile", "plyfile", "PLY files", True),
    ("zstandard", "zstandard", "SPZ version 4", True),
    ("tqdm", "tqdm", "progress", True),
    ("tyro", "tyro", "this command line", True),
    ("matplotlib", "matplotlib", "colours of the error maps", True),
    ("viser", "viser", "pop view: pip install 'pop-splatting[viewer]'", False),
    ("pillow-heif", "pillow_heif", "HEIC photographs: pip install 'pop-splatting[heif]'", False),
    ("snakemake", "snakemake", "blocks on a cluster, or several at a time: pip install 'pop-splatting[blocks]'", False),
    ("hypothesis", "hypothesis", "the conformance kit: pip install 'pop-ref[conformance]'", False),
)


@dataclass(frozen=True)
class DoctorLine:
    """One line of the examination: a thing, its state, what was found, and how to get it when it is missing."""

    name: str
    state: State
    found: str
    fix: str = ""


@dataclass(frozen=True)
class Args:
    """Say what is installed, what is missing and how to get it.

    Exit status 0 when everything that pop needs is there, 1 otherwise. Optional parts that are off do not count.
    """

    lpips_vgg: tuple[str, ...] = ()
    """Also read these LPIPS weights on VGG16: one merged file, or backbone and linear layers."""
    lpips_alex: tuple[str, ...] = ()
    """Also read these LPIPS weights on AlexNet, in the same form."""


def run(argv: Sequence[str]) -> int:
    args = parse(Args, argv, "doctor")
    findings = [*packages(), *machine()]
    if not any(finding.name == "torch" and finding.state == "missing" for finding in findings):
        findings += [*torch_build(), *backends(), *plugins()]
    findings += [cuda_build(), *lpips(args)]
    width = max(len(finding.name) for finding in findings) + 2
    marks = {"ok": "ok", "missing": "MISSING", "off": "-"}
    print(f"pop-splatting {_installed('pop-splatting') or '(not installed)'}, Python {platform.python_version()}")
    for finding in findings:
        fix = f"  ->  {finding.fix}" if finding.fix else ""
        print(f"  {marks[finding.state]:<9}{finding.name:<{width}}{finding.found}{fix}")
    missing = [finding.name for finding in findings if finding.state == "missing"]
    print(f"missing: {', '.join(missing)}" if missing else "everything that pop needs is installed")
    return 1 if missing else 0


def packages() -> Iterator[DoctorLine]:
    """Import every package that pop uses, all but torch, whose library is loaded, and tell its version."""
    for distribution, module, purpose, needed in _PACKAGES:
        version = _installed(distribution)
        # where torch's library does not load by itself, importing it does: it knows more places to look
        fault = None if module == "torch" and _loads() else _why_not_imported(module)
        if fault is not None:
            reason = f"{purpose}; import fails: {fault}" if version else purpose
            fix = f"pip install --force-reinstall {distribution}" if version else f"pip install {distribution}"
            yield DoctorLine(distribution, "missing" if needed else "off", reason, fix if needed else "")
            continue
        yield DoctorLine(distribution, "ok", f"{version or 'version unknown'}  ({purpose})")


def machine() -> Iterator[DoctorLine]:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    yield DoctorLine("processor", "ok", f"{machine_name()}, {cores} usable core{'s' if cores != 1 else ''}")
    total, free = memory_bytes()
    if total:
        low = free < 2e9
        hint = "close other programs, or train with --factor 4" if low else ""
        yield DoctorLine("memory", "ok", f"{total / 1e9:.1f} GB, {free / 1e9:.1f} GB free", hint)


def torch_build() -> Iterator[DoctorLine]:
    """Tell whether torch was built for the CPU alone."""
    with contextlib.suppress(ImportError):
        cuda = cuda_version()
        yield DoctorLine("torch build", "ok", f"CUDA {cuda}" if cuda else "CPU")


def backends() -> Iterator[DoctorLine]:
    """Ask every backend whether it can run here and, if not, why; all of them need torch."""
    for name, backend in BACKENDS.usable():
        if backend.available():
            yield DoctorLine(f"backend {name}", "ok", "can run here")
        else:
            yield DoctorLine(f"backend {name}", "off", f"{backend.why_not()} (optional)")


def plugins() -> Iterator[DoctorLine]:
    """Load what other packages add, and tell which package each is of and why one cannot be used."""
    from pop_fast.data.camera_models import CAMERA_MODELS
    from pop_fast.io.formats import FORMATS
    from pop_fast.train.presets import LOSSES, METHODS
    from pop_ref.constants import PROFILES

    for registry in (METHODS, PROFILES, LOSSES, FORMATS, CAMERA_MODELS, BACKENDS):
        for name, package, fault in registry.added():
            found = f"of {package}" if fault is None else f"{fault} (optional)"
            yield DoctorLine(f"{registry.kind} {name}", "ok" if fault is None else "off", found)


def cuda_build() -> DoctorLine:
    """Tell whether `pop build-cuda` has what it needs here, or what it lacks."""
    from cuda_ext.build import BuildError, tools
    from cuda_ext.toolkit import nvcc_version

    try:
        nvcc, _ = tools()
        version = ".".join(map(str, nvcc_version(nvcc)))
    except (BuildError, RuntimeError, OSError) as error:
        return DoctorLine("CUDA build", "off", f"{error} (optional)")
    return DoctorLine("CUDA build", "ok", f"nvcc {version} at {nvcc}, cmake and nanobind are installed")


def lpips(args: Args) -> Iterator[DoctorLine]:
    """Read the LPIPS weights that were given, or say how to give them."""
    given: dict[Literal["vgg", "alex"], tuple[str, ...]] = {"vgg": args.lpips_vgg, "alex": args.lpips_alex}
    if not any(given.values()):
        fix = "give files with --lpips-alex or --lpips-vgg to doctor, train and eval"
        yield DoctorLine("LPIPS", "off", "no weights given, none are shipped (optional)", fix)
    for net, files in given.items():
        if files:
            from pop_fast.train.lpips import LPIPS

            weights = LPIPS(net, files)
            yield DoctorLine(f"LPIPS {net}", "ok", ", ".join(f"{k} {v[:12]}" for k, v in weights.sha256.items()))


def _why_not_imported(module: str) -> str | None:
    try:
        importlib.import_module(module)
    except Exception as error:  # a broken install raises anything: OSError for a shared library, for one
        return f"{type(error).__name__}: {error}"
    return None


def _installed(distribution: str) -> str | None:
    from importlib.metadata import PackageNotFoundError, version

    with contextlib.suppress(PackageNotFoundError):
        return version(distribution)
