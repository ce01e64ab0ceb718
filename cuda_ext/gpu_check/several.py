"""The stages of `gpu_check` for a node of several GPUs: steps that ranks share, and blocks that are trained at once."""

from __future__ import annotations

import hashlib
import time
from pathlib import Path
from typing import Any

from cuda_ext.gpu_check.shared import StageContext, all_lines, skipped
from cuda_ext.gpu_check.training import TRAIN, captures_of, last_stats, no_capture
from pop_fast.children import python_command

# of the node in a rehearsal, and the steps that are taken there
REHEARSED, FEW = 2, 8


def count_gpus(check: StageContext) -> int:
    """Return how many GPUs the node has."""
    return REHEARSED if check.rehearsal else len(all_lines(["nvidia-smi", "--list-gpus"]))


def ranks_stage(check: StageContext) -> dict[str, Any]:
    """Train on the first capture by 1, 2, 4 ... GPUs, each step of as many views as the node has GPUs.

    The bits must be the same. What a rank received of the others (`received_bytes`) stands with the seconds.
    """
    gpus, captures = count_gpus(check), captures_of(check)
    if gpus < 2:
        return skipped(f"the node has {gpus} GPU; ranks share two or more")
    if not captures:
        return no_capture()
    sizes = [size for size in (1, 2, 4, 8) if gpus % size == 0]
    found: dict[str, Any] = {"status": 0, "seconds": 0.0, "gpus": gpus, "runs": {}}
    for k, size in enumerate(sizes):
        limit = (check.seconds - found["seconds"]) / (len(sizes) - k)
        one = _train(check, captures[0], f"ranks_{size}", limit, size, "--batch-size", str(gpus))
        found["runs"][str(size)] = one
        found |= {"status": found["status"] or one["status"], "seconds": round(found["seconds"] + one["seconds"], 1)}
        check.note(found)
    hashes = {one.get("sha256") for one in found["runs"].values()}
    found["same_bits"] = len(hashes) == 1 and None not in hashes
    return found | {"status": found["status"] or int(not found["same_bits"])}


def blocks_stage(check: StageContext) -> dict[str, Any]:
    """Train on the first capture in blocks, one a GPU, and as a whole: seconds and PSNR of both."""
    gpus, captures = count_gpus(check), captures_of(check)
    if not captures:
        return no_capture()
    found: dict[str, Any] = {"status": 0, "seconds": 0.0, "gpus": gpus, "runs": {}}
    start = time.monotonic()
    for name, words in (("blocks", ("--blocks", f"{max(gpus // 2, 1)}x2")), ("whole", ())):
        left = check.seconds - (time.monotonic() - start)
        one = _train(check, captures[0], name, left / (2 if name == "blocks" else 1), 1, *words)
        found["runs"][name] = one
        found |= {"status": found["status"] or one["status"], "seconds": round(found["seconds"] + one["seconds"], 1)}
        check.note(found)
    return found


def _train(check: StageContext, path: Path, name: str, limit: float, size: int, *more: str) -> dict[str, Any]:
    """Train by so many processes, started by torchrun where they are several."""
    folder = check.work / f"{path.name}_{name}_{check.steps_scaler:g}_{check.commit[:12]}"
    # blocks are processes of their own, in which nothing stands for a GPU in a rehearsal
    backend = "fast" if check.rehearsal and "--blocks" in more else "cuda"
    words = ["train", str(path), "--out", str(folder), "--backend", backend, "--overwrite", "--no-progress", *more]
    words += ["--max-renders", "1", "--skip-sizes", "--skip-checks", "--threads", "1"]
    words += ["--max-steps", str(FEW)] if check.rehearsal else ["--steps-scaler", str(check.steps_scaler)]
    command = check.python("-c", TRAIN, *words)
    if size > 1:
        launcher = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(size), "--no-python")
        command = [*python_command(*launcher), *command]
    found = check.run(command, limit)
    told = last_stats(folder)
    if found["status"] == 0 and told is None:
        found["status"] = 1
    plies = sorted((folder / "ply").glob("*.ply"))
    if plies:
        found["sha256"] = hashlib.sha256(plies[-1].read_bytes()).hexdigest()
    return {**(told or {}), **found}
