"""Checkpoints: all that a run needs to continue with the same bits, in one file that is written whole or not at all.

The file is a dict that `torch.load(weights_only=True)` reads, so loading one cannot run code. `splats` and `step` are
gsplat's keys: its trainer evaluates these files as they are. What is read is checked first, bit by bit against its
checksums and entry by entry (`checkpoint_checks`), so that a damaged or forged file ends in a sentence.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam, Optimizer

from pop_fast.data.capture import Capture
from pop_fast.density.protocol import State
from pop_fast.errors import PopError
from pop_fast.io.atomic import write_atomically
from pop_fast.io.read_back import read_torch_file
from pop_fast.train.checkpoint_checks import check_content, check_splats, shown
from pop_fast.train.config import TrainConfig, first_difference
from pop_fast.train.model import KEYS, make_optimizers

FORMAT = 1
_NAME = re.compile(r"ckpt_(\d+)_rank0\.pt")
_DAMAGED = "remove the file to continue from the one before it"
_NEEDED = (
    "format",
    "step",
    "splats",
    "optimizers",
    "strategy",
    "view_order",
    "config",
    "capture",
    "metrics_bytes",
    "seconds",
    "threads",
)


def checkpoint_path(result_dir: Path, step: int) -> Path:
    """Return the name of the checkpoint after that step (counted from 0, as in gsplat)."""
    return result_dir / "ckpts" / f"ckpt_{step}_rank0.pt"


def list_checkpoints(result_dir: Path) -> list[tuple[int, Path]]:
    """Return (step, file) of the checkpoints of a result folder, the latest last."""
    folder = result_dir / "ckpts"
    if not folder.is_dir():
        return []
    found = ((_NAME.fullmatch(path.name), path) for path in folder.iterdir())
    return sorted((int(match[1]), path) for match, path in found if match)


def prune_checkpoints(result_dir: Path, keep_last: int, keep_steps: set[int]) -> None:
    """Remove all but the latest `keep_last` checkpoints and those of `keep_steps`."""
    found = list_checkpoints(result_dir)
    for step, path in found[: max(len(found) - keep_last, 0)]:
        if step not in keep_steps:
            path.unlink()


def save_checkpoint(path: Path, content: Mapping[str, Any]) -> None:
    """Write a checkpoint; a reader finds the old file or the new one, never a part.

    Raises:
        PopError: the operating system refused, as when the disk is full; names the file and what to do.
    """

    def write(file: BinaryIO) -> None:
        try:
            torch.save({"format": FORMAT, **content}, file)
        except RuntimeError as error:
            # torch says at which byte writing failed, and not why
            if isinstance(error.__context__, OSError):
                raise error.__context__ from error
            raise

    write_atomically(path, write)


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint of a training run, checked.

    Raises:
        PopError: the file is absent, damaged, of another format, not a checkpoint of a training run, or holds what none
            can have written; names the entry and what to do.
    """
    earlier = earlier_checkpoint(path)
    instead = f"to continue from {earlier.name}" if earlier else "and train again, or copy it again if you have another"
    fix = f"remove it {instead}"
    content = read_torch_file(path, fix)
    missing = [key for key in _NEEDED if not isinstance(content, dict) or key not in content]
    if missing:
        raise PopError(f"{path}: has no {missing[0]!r}, so it is not a checkpoint of 'pop train'; {fix}")
    if type(content["format"]) is not int or content["format"] != FORMAT:
        raise PopError(f"{path}: has format {shown(content['format'])}; this version reads format {FORMAT}")
    named = _NAME.fullmatch(path.name)
    try:
        content = check_content(content)
        if named and content["step"] != int(named[1]):
            raise ValueError(f"step is {content['step']}; it must be {named[1]}, as the file's name says")
    except ValueError as error:
        raise PopError(f"{path}: {error}; {fix}") from error
    return content


def load_splats(path: Path) -> tuple[dict[str, Tensor], int | None]:
    """Read the raw parameters of a checkpoint, ours or gsplat's, as float32, and its step where it tells one.

    Raises:
        PopError: the file is absent or damaged, or the parameters are; names the entry and what to do.
    """
    earlier = earlier_checkpoint(path)
    fix = f"use an earlier one ({earlier})" if earlier else "copy it again, or use another one"
    content = read_torch_file(path, fix)
    try:
        if not isinstance(content, dict) or "splats" not in content:
            raise ValueError("has no splats, so it is no checkpoint of 'pop train' or gsplat")
        params = check_splats(content["splats"])
    except ValueError as error:
        raise PopError(f"{path}: {error}; {fix}") from error
    step = content.get("step")
    return params, step if type(step) is int and step >= 0 else None


def earlier_checkpoint(path: Path) -> Path | None:
    """Return the checkpoint of the same run before this one, or None where there is none."""
    match, found = _NAME.fullmatch(path.name), list_checkpoints(path.parent.parent)
    if match is None or path not in [other for _, other in found]:
        return None
    return next((other for step, other in reversed(found) if step < int(match[1])), None)


def check_fits(
    path: Path,
    content: Mapping[str, Any],
    config: TrainConfig,
    fingerprint: Mapping[str, str],
    threads: int | None,
    n_views: int,
    known: Collection[str],
) -> None:
    """Check that a checkpoint belongs to a run.

    Args:
        path: of the checkpoint.
        content: what it holds, checked.
        config: the run's settings.
        fingerprint: of the run's capture.
        threads: of one operation; None where the bits of the steps do not depend on it.
        n_views: how many the run trains on.
        known: what the state of the run's strategy holds.

    Raises:
        PopError: it belongs to other settings or another capture, or cannot be of this run; names what differs.
    """
    theirs = {**content["config"], "threads": content["threads"]}
    ours = {**config.binding(), "threads": content["threads"] if threads is None else threads}
    found = first_difference(ours, theirs)
    if found:
        name, ours, theirs = found
        raise PopError(
            f"{path}: was written with {name} = {theirs}, but this run has {name} = {ours}; "
            f"use the same settings, or another result folder"
        )
    for name, ours in fingerprint.items():
        theirs = content["capture"].get(name)
        if theirs != ours:
            raise PopError(
                f"{path}: was written for another capture: the {name} differ ({str(theirs)[:12]}, here {ours[:12]}); "
                "use the same photographs and model, or another result folder"
            )
    last, order = config.max_steps - 1, content["view_order"]["order"]
    odd = sorted(set(known) ^ content["strategy"].keys())
    learned = {name: len(found["value"]) for name, found in content["appearance"].items()}
    expected = {
        **({"exposures": n_views} if config.exposure else {}),
        **({"cameras": n_views} if config.refine_cameras else {}),
    }
    if content["step"] > last:
        raise PopError(f"{path}: step is {content['step']}; it must be at most {last}, the run's last: {_DAMAGED}")
    if len(order) not in (0, n_views):
        raise PopError(f"{path}: view_order.order has {len(order)} views; it must have {n_views}: {_DAMAGED}")
    if learned != expected:
        raise PopError(f"{path}: appearance has the rows {learned}; it must have {expected}: {_DAMAGED}")
    if odd:
        what = "missing" if odd[0] in known else "unknown"
        raise PopError(f"{path}: strategy.{odd[0]} is {what}; it must hold {', '.join(known)}: {_DAMAGED}")


def capture_fingerprint(capture: Capture, test_every: int) -> dict[str, str]:
    """Hash what of a capture reaches the training, part by part, so that a difference can be named."""
    views = capture.train_views(test_every)
    parts: dict[str, list[Any]] = {"view names": [], "photographs": [], "masks": [], "cameras": [], "sparse points": []}
    for view in views:
        parts["view names"].append(os.fsencode(view.name))
        parts["photographs"].append(view.image)
        parts["masks"].append(b"none" if view.mask is None else view.mask)
        parts["cameras"] += [view.viewmat, view.K]
    parts["sparse points"] = [capture.points, capture.points_rgb]
    return {name: _digest(items) for name, items in parts.items()}


def _digest(items: list[Any]) -> str:
    digest = hashlib.sha256()
    for item in items:
        array = np.frombuffer(item, np.uint8) if isinstance(item, bytes) else np.ascontiguousarray(item)
        digest.update(json.dumps([str(array.dtype), list(array.shape)]).encode())
        digest.update(array.data)
    return digest.hexdigest()


def pack_optimizers(optimizers: Mapping[str, Optimizer]) -> dict[str, dict[str, Tensor]]:
    """Return each optimizer's moments and step counter."""
    packed = {}
    for key, optimizer in optimizers.items():
        state = optimizer.state[optimizer.param_groups[0]["params"][0]]
        packed[key] = {name: value.detach() for name, value in state.items()}
    return packed


def unpack_optimizers(optimizers: Mapping[str, Optimizer], packed: Mapping[str, Mapping[str, Tensor]]) -> None:
    """Put back what `pack_optimizers` took."""
    for key, optimizer in optimizers.items():
        optimizer.state[optimizer.param_groups[0]["params"][0]] = dict(packed[key])


def pack_strategy(state: State) -> dict[str, Any]:
    """Return a strategy's state with its random generators as their states."""
    return {k: v.get_state() if isinstance(v, torch.Generator) else v for k, v in state.items()}


def unpack_strategy(state: State, packed: Mapping[str, Any]) -> None:
    """Put back what `pack_strategy` took into a freshly initialised state."""
    for key, value in packed.items():
        if isinstance(state.get(key), torch.Generator):
            state[key].set_state(value)
        else:
            state[key] = value


def moved_to(
    device: torch.device, params: Mapping[str, Parameter], optimizers: Mapping[str, Adam], state: State
) -> tuple[dict[str, Parameter], dict[str, Adam]]:
    """Return parameters and their optimizers on a device; the statistics in `state` are replaced by theirs there."""
    moments = pack_optimizers(optimizers)
    placed = {key: Parameter(params[key].detach().to(device)) for key in KEYS}
    made = make_optimizers(placed)
    for key, found in moments.items():
        there = {name: value if name == "step" else value.to(device) for name, value in found.items()}
        made[key].state[placed[key]] = there
    for key, value in state.items():
        state[key] = value.to(device) if isinstance(value, Tensor) else value
    return placed, made


def on_cpu(content: Any) -> Any:
    """Return nested dicts with their tensors on the CPU; those that are there already are not copied."""
    if isinstance(content, Mapping):
        return {key: on_cpu(value) for key, value in content.items()}
    return content.cpu() if isinstance(content, Tensor) else content
