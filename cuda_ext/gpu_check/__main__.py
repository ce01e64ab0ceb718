"""Everything that only a GPU can tell, in four jobs of limited length, on a bare GPU node: no network, pip or git.

    python3 -m cuda_ext.gpu_check            job 1: build, a half-minute smoke, times, counters, gsplat's times
    python3 -m cuda_ext.gpu_check --job 2    job 2: laws, steps, sanitizer, training
    python3 -m cuda_ext.gpu_check --job 3    job 3: rows of the paper's tables, on captures that were brought along
    python3 -m cuda_ext.gpu_check --job 4    job 4, on a node of several GPUs: steps shared by ranks, blocks at once

What has to be there: Python 3.11 or newer with torch for CUDA, NumPy, nanobind, hypothesis and pytest, cmake, nvcc.
Results go to the folder named first, else to $OUT, else to out/gpu_check/results: one JSON file a job, and next to it
what its stages wrote while they ran. Nothing need survive between the jobs: each builds first, and keeps what it finds
built. A stage that fails or runs out of time is reported with the reason, and the next one runs. What an earlier call
found stays in the file where commit and machine are the same.

What travels is made beforehand, where there is a network, by --pack FOLDER, and read by --packed FOLDER:
    scenes/NAME.npz    trained Gaussians and their cameras, of every folder under --runs
    captures/NAME/     photographs as JPEG, shrunk to --pixels, with cameras and points in COLMAP's text files, of every
                       folder under --captures; with all their bytes of every folder under --whole, or as rows see them
                       of every scene under --prepared, in one file: job 3 needs one of the two, and photographs with
                       distortion the second, since a bare node has no pycolmap
    wheels/*.whl       pure Python: beartype, plyfile, tyro, typeguard, docstring-parser, typing-extensions, jaxtyping,
                       wadler-lindig, gsplat (which compiles its kernels on the node)
    manifest.json      the commit, and every file's size and SHA-256
All of it, with the repository's own files, must be under 64 MiB. Every part of it may be absent.
"""

from __future__ import annotations

import argparse
import math
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from dataclasses import replace
from pathlib import Path
from typing import Any

from cuda_ext.gpu_check.shared import (
    COMMIT,
    ROOT,
    SHORTEST,
    UNKNOWN,
    Budget,
    StageContext,
    first_line,
    python_path,
    read_json,
    write_json,
)
from cuda_ext.gpu_check.stages import JOBS, SHARES, STAGES
from pop_fast.children import python_command

PLACE = ROOT / "out" / "gpu_check"
PACKED = ROOT / "out" / "gpu_pack"


def commit_of(packed: Path | None) -> str:
    """Return the commit: what the environment says, git, or what was packed; else "unknown"."""
    commit = os.environ.get(COMMIT, "")
    if not commit and (ROOT / ".git").exists():
        commit = first_line(["git", "rev-parse", "HEAD"]) or ""
    if not commit and packed is not None:
        commit = str(read_json(packed / "manifest.json").get("commit", ""))
    return commit or UNKNOWN


def environment(commit: str) -> dict[str, Any]:
    """Describe the machine, the driver, the versions and the commit."""
    query = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total,clocks.max.sm", "--format=csv,noheader"]
    found: dict[str, Any] = {
        "gpu": first_line(query),
        "cpu": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "commit": commit,
    }
    if (ROOT / ".git").exists():
        found["dirty"] = first_line(["git", "status", "--porcelain"]) is not None
    try:
        from importlib.metadata import version

        found["torch"] = version("torch")
    except ImportError:
        found["torch"] = None
    return found


def begun_report(path: Path) -> dict[str, Any]:
    """Return the report that earlier calls of a job have left, and an empty one where it is absent or damaged."""
    report = read_json(path)
    stages = report.get("stages")
    return {**report, "stages": dict(stages) if isinstance(stages, dict) else {}}


def run_stages(names: list[str], limit: float, check: StageContext, report: dict[str, Any], path: Path) -> list[str]:
    """Run stages in order, each in its share of the time, and write down what each found; return those that failed."""
    # how long emulated kernels take says nothing: only the limit ends them
    shares = {name: replace(share, most=limit) for name, share in SHARES.items()} if check.rehearsal else SHARES
    budget = Budget(limit, shares, names)
    failed: list[str] = []
    report["stages"] |= {name: {"status": None, "state": "not begun"} for name in names}
    write_json(path, report)
    for name in names:

        def note(found: dict[str, Any], name: str = name) -> None:
            report["stages"][name] = found
            write_json(path, report)

        found = _held(name, replace(check, seconds=budget.seconds(name), note=note))
        note(found)
        words = "skipped" if "skipped" in found else "ok" if found["status"] == 0 else "FAILED"
        print(f"{name}: {words} in {found['seconds']} s", flush=True)
        if found["status"] != 0:
            failed.append(name)
        if words != "ok":
            said = [found["skipped"]] if "skipped" in found else [found.get("output", "")[-1500:], found.get("note")]
            print("\n".join(filter(None, said)), flush=True)
    report["complete"] = True
    write_json(path, report)
    return failed


def _held(name: str, check: StageContext) -> dict[str, Any]:
    """Run a stage; what it raises is kept, and does not reach the other stages."""
    if check.seconds < SHORTEST:
        return {"status": 124, "seconds": 0.0, "output": "no time was left; name the stage in another call"}
    start = time.monotonic()
    check.note({"status": None, "state": "begun", "seconds_given": round(check.seconds, 1)})
    try:
        return STAGES[name](check)
    except Exception:
        return {"status": 1, "seconds": round(time.monotonic() - start, 1), "output": traceback.format_exc()}


def _results_folder(given: Path | None) -> Path:
    folder = given or Path(os.environ.get("OUT") or PLACE / "results")
    if folder.exists() and not folder.is_dir():
        raise SystemExit(f"gpu_check: {folder} is a file; name a folder for the results")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SystemExit(f"gpu_check: {folder}: {error.strerror}; name another folder for the results") from error
    return folder.resolve()


def _pack(folder: Path, args: argparse.Namespace) -> int:
    """Let the packing script, which needs the whole program, do its work."""
    words = [str(ROOT / "benchmarks" / "gpu_pack.py"), str(folder), "--pixels", str(args.pixels)]
    words += ["--runs", *map(str, args.runs), "--captures", *map(str, args.captures)]
    words += ["--whole", *map(str, args.whole), "--data", str(args.data), "--prepared", *args.prepared]
    words += ["--no-wheels"] if args.no_wheels else []
    path = python_path(ROOT, ROOT / "benchmarks")
    done = subprocess.run(python_command(*words), env={**os.environ, "PYTHONPATH": path}, check=False)
    return done.returncode


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python3 -m cuda_ext.gpu_check", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, nargs="?", help="the folder of results; default: $OUT")
    parser.add_argument("--job", type=int, choices=list(JOBS), default=1, help="which of the four; default 1")
    parser.add_argument("--stages", nargs="+", choices=list(STAGES), help="others than the job's, in this order")
    parser.add_argument("--limit-s", type=float, default=560.0, help="seconds for all stages together; default 560")
    parser.add_argument("--packed", type=Path, help="what was brought along; default: out/gpu_pack, if it is there")
    parser.add_argument("--captures", nargs="*", type=Path, default=[], help="folders to train on, or to pack")
    parser.add_argument("--steps-scaler", type=float, default=1.0, help="of 30,000 steps, for stage train")
    parser.add_argument("--rehearse", action="store_true", help="without a GPU: emulate the kernels, on tiny cases")
    parser.add_argument("--pack", type=Path, metavar="FOLDER", help="make what travels, and run nothing")
    parser.add_argument("--runs", nargs="*", type=Path, default=[], help="results of `pop train` to pack")
    parser.add_argument("--whole", nargs="*", type=Path, default=[], help="folders of captures to pack as they are")
    parser.add_argument("--prepared", nargs="*", default=[], metavar="SCENE", help="scenes to pack as rows see them")
    parser.add_argument("--data", type=Path, default=Path("data"), help="the folder of these scenes; default data")
    parser.add_argument("--pixels", type=float, default=4e5, help="of a packed photograph, at most; default 400,000")
    parser.add_argument("--no-wheels", action="store_true", help="pack no wheels: nothing is downloaded")
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run a job, or pack what it takes along, from the command line."""
    args = _parser().parse_args(argv)
    if math.isnan(args.limit_s):
        raise SystemExit("gpu_check: --limit-s is nan; give seconds, for example 560")
    if args.pack is not None:
        return _pack(args.pack.resolve(), args)
    out = _results_folder(args.out)
    packed = args.packed or (PACKED if PACKED.is_dir() else None)
    if packed is not None and not packed.is_dir():
        raise SystemExit(f"gpu_check: {packed}: no such folder; make it with --pack, or leave --packed out")
    commit = commit_of(packed)
    path = out / f"gpu_check_{args.job}.json"
    report, here = begun_report(path), environment(commit)
    if (report.get("rehearsal"), report.get("environment")) != (args.rehearse, here):
        # what another commit, another machine or the emulator came to says nothing of this call
        report["stages"] = {}
    report |= {"job": args.job, "complete": False, "rehearsal": args.rehearse, "limit_s": args.limit_s}
    report["environment"] = here
    check = StageContext(
        *(0.0, out, PLACE if os.access(ROOT, os.W_OK) else Path(tempfile.mkdtemp(prefix="gpu_check_"))),
        *(path.with_suffix(".log"), packed.resolve() if packed else None),
        *(tuple(folder.resolve() for folder in args.captures), args.steps_scaler, commit, args.rehearse),
        note=lambda found: None,
    )
    names = args.stages or list(JOBS[args.job])
    if here.get("gpu", "") is None and not args.rehearse:
        print("note: nvidia-smi names no GPU here, which most stages need; --rehearse emulates one", flush=True)
    try:
        failed = run_stages(names, args.limit_s, check, report, path)
    finally:
        # what runs along with the stages is not left behind
        for command in check.beside.values():
            command.kill()
    left_out = [name for name in names if "skipped" in report["stages"][name]]
    words = [f"failed: {', '.join(failed)}" if failed else "none failed" if left_out else "every stage ran"]
    words += [f"skipped: {', '.join(left_out)}"] if left_out else []
    print(f"{path}: {'; '.join(words)}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    # a job that is ended takes its commands, which have sessions of their own, along
    for ending in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # what nohup, or a shell in the background, told to be ignored stays ignored
        if signal.getsignal(ending) != signal.SIG_IGN:
            signal.signal(ending, lambda number, _: sys.exit(128 + number))
    sys.exit(main())
