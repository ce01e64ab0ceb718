"""Train a finished row again with the program of its own commit, and compare: the bits on the same kind of machine.

Two machines are of one kind where processor, threads and the versions of what computes are equal. There a training is
a function of its commit, settings and photographs, so everything that a result says must come out again: the points of
the curve to the digits that it keeps, every held-out view and the Gaussians to the last bit. Elsewhere sums are rounded
otherwise, and what comes out must lie within `TOLERANCES`.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from paper_repro.collect import curve_of, digits, file_hash, final_stats, ply_of
from paper_repro.jobs import Job
from paper_repro.results import Result
from paper_repro.scenes import MADE, find_folder
from paper_repro.train_row import Options, git
from pop_fast.api.backend import backend_names, get_backend
from pop_fast.children import python_command
from pop_fast.errors import PopError
from pop_fast.machine import machine_name, processor_kind

# how far another kind of machine may come out: a share of the Gaussians, and dB and SSIM of the held-out views
TOLERANCES: Final = {"num_gaussians": 0.05, "psnr_test": 0.3, "ssim": 0.01}
_ROOT: Final = Path(__file__).resolve().parents[1]
# what trains, by names that `pop-repro` of every commit has; the words of its command line have changed
_TRAIN: Final = """\
import json, sys
from pathlib import Path
from paper_repro.jobs import job_named
from paper_repro.train_row import Options, train_row
asked = json.loads(sys.argv[1])
places = {name: Path(asked[name]) for name in ("data", "results", "work")}
how = {"threads": asked["threads"], "backend": asked["backend"], "keep_ply": True, "quiet": True}
train_row(job_named(*asked["job"]), Options(**places, **how))
"""


@dataclass(frozen=True)
class Verification:
    """What came out."""

    kind: tuple[str, ...]  # what of the machine is another; empty on the same kind
    points: int  # points of the curve that were compared
    steps: int  # that were trained
    finished: bool  # whether those are all, so that the end was compared too
    # what came out otherwise, each with the result's value; empty where the result is confirmed
    differences: tuple[str, ...]
    begun: str | None = None  # another commit, which took the result's first steps; None where its own took all


def verify(job: Job, options: Options, steps: int | None = None) -> Verification:
    """Train a job's result again with the program of its commit, and compare.

    The clone and what is trained lie in the work folder, under "verify", until there is a verdict: the same call
    continues a training that was stopped.

    Args:
        job: that has a result.
        options: the data, the results and the work folder, and the backend; "auto" is that of the result.
        steps: after so many the training is stopped; None trains all.

    Raises:
        PopError: there is no result, it names no commit of this clone, its scene is absent, or the training failed.
        KeyboardInterrupt: after Ctrl-C or SIGTERM, when the training has written a checkpoint.
    """
    result = job.result(options.results)
    if result is None:
        raise PopError(f"{job.file(options.results)}: has no result of {job.scene.name}, seed {job.seed}, to verify")
    _require_commit(result, _ROOT)
    # what is lacking is said before minutes of cloning and compiling
    _ = job.scene.name in MADE or find_folder(job.scene, options.data)
    options = replace(options, backend=options.backend if options.backend != "auto" else _backend_of(result))
    why_not = None if options.backend == "auto" else get_backend(options.backend).why_not()
    if why_not is not None:
        raise PopError(f"{job}: backend {options.backend} cannot run here: {why_not}, or name another with --backend")
    # git is run from elsewhere
    place = job.work(options.work.absolute() / "verify").with_name(f"{job.scene.name}_{job.seed}_{result.commit}")
    _check_out(str(result.commit), place / "clone", options.backend)
    taken = _train(job, result, options, place, steps)
    verdict = _compare(result, job.work(place / "work"), taken, other_kind(result, options.backend))
    shutil.rmtree(place)
    return verdict


def history(root: Path = _ROOT) -> frozenset[str] | None:
    """Return the commits that the clone's branch consists of; None outside a clone, and in one without its history."""
    shallow = git(root, "rev-parse", "--is-shallow-repository")
    if shallow.returncode != 0 or shallow.stdout.strip() == "true":
        return None
    return frozenset(git(root, "rev-list", "HEAD").stdout.split())


def other_kind(result: Result, backend: str = "auto") -> tuple[str, ...]:
    """Name in what this machine is of another kind than the one that trained a result; empty on the same kind.

    Args:
        result: that was trained.
        backend: that trains here; "auto" is that of the result.
    """
    from pop_fast.train.environment import versions

    was = _backend_of(result)
    engine = {"backend": was if backend == "auto" else backend}
    here = {"processor": machine_name(), "kind of processor": processor_kind(), **engine, **versions()}
    there = {"processor": result.machine, "kind of processor": result.cpu, "backend": was, **result.versions}
    return tuple(
        f"{name} is {here[name]} and was {there[name]}"
        for name in here
        if there.get(name) is not None and here[name] != there[name] and name != "pop-splatting"
    )


def _require_commit(result: Result, root: Path) -> None:
    what = f"{result.row} {result.scene} --scale {result.scale} --seed {result.seed}"
    if result.commit is None or result.commit.endswith("-dirty"):
        raise PopError(f"{what}: its commit is {result.commit}, which is no commit; train it again in a clean clone")
    if git(root, "rev-parse", "HEAD").returncode != 0:
        raise PopError(f"{root}: is not a clone of the repository, which has the program of commit {result.commit}")
    if git(root, "cat-file", "-e", f"{result.commit}^{{commit}}").returncode != 0:
        raise PopError(f"{what}: commit {result.commit} is not in {root}; fetch the whole history, or train it again")


def _check_out(commit: str, clone: Path, backend: str) -> None:
    """Clone the repository at a commit, with what the backend runs compiled there; what is there already is taken."""
    if not clone.is_dir():
        partial = clone.with_suffix(".partial")
        shutil.rmtree(partial, ignore_errors=True)
        partial.parent.mkdir(parents=True, exist_ok=True)
        for words in (
            ("clone", "--quiet", "--shared", "--no-checkout", str(_ROOT), str(partial)),
            ("-C", str(partial), "checkout", "--quiet", "--detach", commit),
        ):
            done = git(_ROOT, *words)
            if done.returncode != 0:
                raise PopError(f"git {words[0]} of commit {commit} failed: {done.stderr.strip()}")
        # a library's name holds the digest of its source: one that does not fit is not loaded
        for library in (_ROOT / "pop_fast" / "compiled").glob("_blend_*.so"):
            shutil.copy2(library, partial / "pop_fast" / "compiled")
        partial.rename(clone)
    # the kernels of a GPU lie in the clone's own folder, too
    builds = [("pop_fast.compiled.build", "--if-possible"), *([("cuda_ext.build",)] if backend == "cuda" else [])]
    for words in builds:
        command = python_command("-m", *words)
        done = subprocess.run(command, env=_environment(clone, 1), cwd=clone, capture_output=True, text=True)
        if done.returncode != 0:
            tail = " ".join(done.stderr.strip().splitlines()[-1:])
            raise PopError(f"{clone}: python -m {words[0]} of commit {commit} failed: {tail}")


def _train(job: Job, result: Result, options: Options, place: Path, steps: int | None) -> int:
    """Train in the clone, and return how many steps were taken: all, or some more than were asked for."""
    last = int(result.schedule["max_steps"])
    wanted = last if steps is None else min(steps, last)
    asked = {
        "job": [job.row.name, job.scene.name, job.scale.name, job.seed],
        "data": str(options.data.absolute()),
        "results": str(place / "results"),
        "work": str(place / "work"),
        "threads": result.threads,
        "backend": options.backend,
    }
    command = python_command("-c", _TRAIN, json.dumps(asked))
    clone, work = place / "clone", job.work(place / "work")
    # a session of its own: a terminal's Ctrl-C would reach it as well as what is passed on, and two mean "at once"
    with open(place / "log.txt", "w") as log:
        process = subprocess.Popen(
            command, cwd=clone, env=_environment(clone, result.threads), stdout=log, stderr=log, start_new_session=True
        )
        with _ended_with_us(process):
            while process.poll() is None and (wanted == last or _steps_taken(work) <= wanted):
                time.sleep(0.2)
        stopped = process.poll() is None
        if stopped:
            process.terminate()
        status = process.wait()
    if status != 0 and not stopped:
        tail = (place / "log.txt").read_text(encoding="utf-8").strip().splitlines()[-1:]
        raise PopError(f"{job}: training it at commit {result.commit} failed with status {status}: {' '.join(tail)}")
    return _steps_taken(work)


@contextmanager
def _ended_with_us(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """Let Ctrl-C and SIGTERM end the training too, which writes a checkpoint first."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    except KeyboardInterrupt:
        process.terminate()
        process.wait()
        raise
    finally:
        signal.signal(signal.SIGTERM, before)


def _steps_taken(work: Path) -> int:
    """Return how many steps a training has taken, as far as its records say."""
    path = work / "metrics.jsonl"
    # the last line may be in the middle of being written
    lines = path.read_text(encoding="utf-8").split("\n")[:-1] if path.is_file() else []
    return int(json.loads(lines[-1])["step"]) + 1 if lines else 0


def _compare(result: Result, work: Path, taken: int, kind: tuple[str, ...]) -> Verification:
    last = int(result.schedule["max_steps"])
    finished = (work / "stats" / f"val_step{last - 1:04d}.json").is_file()
    # of the last step that was logged some may not have been written
    now = {point["step"]: point for point in curve_of(work, last) if finished or point["step"] < taken - 1}
    equal = _within if kind else _equal
    # on another kind, the Gaussians that a training begins with say nothing of what it does
    first = result.curve[0]["num_gaussians"] if result.curve else 0
    told = [p for p in result.curve if not kind or "psnr_test" in p or p["num_gaussians"] != first]
    common = [(point, now[point["step"]]) for point in told if point["step"] in now]
    if not common and not finished:
        what = " that another kind of machine can be held to" if kind else ""
        least = f"at least {told[0]['step'] + 1:,}" if told else "all"
        raise PopError(
            f"{work}: after {taken:,} steps there is no point of the curve of run {result.run}{what}; take {least} "
            "with --steps"
        )
    found = [
        f"step {then['step']:,}: {name} is {point[name]}, and the result has {then[name]}"
        for then, point in common
        for name in then
        if name in point and name not in ("step", "seconds") and not equal(name, point[name], then[name])
    ]
    if finished:
        found += _differences_at_the_end(result, work, last - 1, bool(kind))
    begun = result.protocol.get("begun")
    return Verification(kind, len(common), last if finished else taken, finished, tuple(found), begun)


def _differences_at_the_end(result: Result, work: Path, last: int, within: bool) -> list[str]:
    stats = final_stats(work, last)
    pairs = {
        "num_gaussians": (stats["num_GS"], result.num_gaussians),
        "psnr_test": (stats["psnr"], result.psnr),
        "ssim": (stats["ssim"], result.ssim),
    }
    if within:
        differ = {name: pair for name, pair in pairs.items() if not _within(name, *pair)}
    else:
        views = {name: {key: view[key] for key in ("psnr", "ssim")} for name, view in stats["per_view"].items()}
        pairs |= {f"per_view {name}": (views.get(name), dict(then)) for name, then in result.per_view.items()}
        if result.ply_hash is not None:
            pairs["ply_hash"] = file_hash(ply_of(work, last)), result.ply_hash
        differ = {name: (now, then) for name, (now, then) in pairs.items() if now != then}
    return [f"at the end: {name} is {now}, and the result has {then}" for name, (now, then) in differ.items()]


def _equal(name: str, now: float, then: float) -> bool:
    """Tell whether two values are equal to the digits that a curve keeps; the last may have been rounded twice."""
    if isinstance(then, int):
        return now == then
    exponent = int(f"{then:e}".partition("e")[2])
    return abs(now - then) < 1.5 * 10.0 ** (exponent - digits(name) + 1)


def _within(name: str, now: float, then: float) -> bool:
    """Tell whether a value is one that another kind of machine may come to; of most columns nothing is asked."""
    if name not in TOLERANCES:
        return True
    return abs(now - then) <= TOLERANCES[name] * (max(then, 1) if name == "num_gaussians" else 1.0)


def _backend_of(result: Result) -> str:
    """Return the backend that takes the steps as a result's engine did."""
    by_autograd = re.fullmatch(r"torch \((.+)\)", result.engine)
    if by_autograd:
        return by_autograd[1]
    steps = {name: get_backend(name).whole_step() for name in backend_names()}
    return next((name for name, step in steps.items() if step is not None and step.name == result.engine), "auto")


def _environment(clone: Path, threads: int) -> Mapping[str, str]:
    return {**os.environ, "PYTHONPATH": str(clone), "OMP_NUM_THREADS": str(max(threads, 1))}
