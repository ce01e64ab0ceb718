"""Checkpoints: all that a run needs to continue with the same bits, in one file that is written whole or not at all.

The file is a dict that `torch.load(weights_only=True)` reads, so loading one cannot run code. `splats` and `step` are
gsplat's keys: its trainer evaluates these files as they are. What is read is checked first, bit by bit against its
checksums and entry by entry, so that a damaged or forged file ends in a sentence.

torch's fused Adam takes the addresses of a parameter and its moments but the length of the first alone: with a moment
of another shape it writes where it must not. So nothing of a file reaches a run unchecked. A file can also hold tensors
that are views of one another, or one number that claims to be a billion.

What is refused is what no run can have written. Parameters and first moments are finite, because a run that loses that
stops before it saves. Second moments and sums of gradients are at least 0, and may be infinite: the square of a large
gradient overflows while the parameter that it is for continues.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, BinaryIO, Final

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
from pop_fast.train.config import TrainConfig, first_difference, is_of_another_version
from pop_fast.train.model import KEYS, MOMENTS, first_non_finite, first_unusable, make_optimizers

FORMAT = 1
_NAME = re.compile(r"ckpt_(\d+)_rank0\.pt")
_DAMAGED = "remove the file to continue from the one before it"
_NEEDED = (
    *("format", "step", "splats", "optimizers", "strategy", "view_order", "config", "capture"),
    *("metrics_bytes", "seconds", "threads"),
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
    """Remove all but the latest `keep_last` checkpoints, those of `keep_steps`, and those that a PLY was kept with."""
    found = list_checkpoints(result_dir)
    for step, path in found[: max(len(found) - keep_last, 0)]:
        # a resumed run need not be told the steps again after which something is kept
        if step not in keep_steps and not (result_dir / "ply" / f"point_cloud_{step}.ply").exists():
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


def load_checkpoint(path: Path, like: Mapping[str, Tensor] | None = None) -> dict[str, Any]:
    """Read a checkpoint of a training run, checked.

    Args:
        like: raw parameters of the run, whose precision and colour bands those of the file must have; None stands for
            float32 and all bands.

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
        content = check_content(content, like)
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
            raise ValueError("has no splats, so it is not a checkpoint of 'pop train' or gsplat")
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
        threads: of one operation; None where the bits of the steps do not depend on it.

    Raises:
        PopError: it belongs to other settings or another capture, or cannot be of this run; names what differs.
    """
    theirs = {**content["config"], "threads": content["threads"]}
    ours = {**config.binding(), "threads": content["threads"] if threads is None else threads}
    found = first_difference(ours, theirs)
    if found:
        name, mine, other = found
        fix = "use the same settings, or another result folder"
        wrote = f"was written with {name} = {other}, but this run has {name} = {mine}"
        if is_of_another_version(name, ours, theirs):
            wrote, fix = (
                f"is of a version with other settings than this one ({name})",
                "resume with the version that wrote it, or train anew in another result folder",
            )
        raise PopError(f"{path}: {wrote}; {fix}")
    for name, ours in fingerprint.items():
        theirs = content["capture"].get(name, ours)  # earlier versions wrote no alpha and no tracks
        if theirs != ours:
            raise PopError(
                f"{path}: was written for another capture: the {name} differ ({str(theirs)[:12]}, here {ours[:12]}); "
                "use the same photographs and model, or another result folder"
            )
    last, order = config.max_steps - 1, content["view_order"]["order"]
    odd = sorted(set(known) ^ content["strategy"].keys())
    learned = {name: len(found["value"]) for name, found in content["appearance"].items()}
    asked = {"exposures": config.exposure, "cameras": config.refine_cameras}
    expected = {name: n_views for name, is_learned in asked.items() if is_learned}
    if content["step"] > last:
        raise PopError(f"{path}: step is {content['step']}; it must be at most {last}, the run's last: {_DAMAGED}")
    if len(order) not in (0, n_views):
        raise PopError(f"{path}: view_order.order has {len(order)} views; it must have {n_views}: {_DAMAGED}")
    if learned != expected:
        raise PopError(f"{path}: appearance has the rows {learned}; it must have {expected}: {_DAMAGED}")
    if odd:
        what = "missing" if odd[0] in known else "unknown"
        raise PopError(f"{path}: strategy.{odd[0]} is {what}; it must hold {', '.join(known)}: {_DAMAGED}")


def capture_fingerprint(capture: Capture, config: TrainConfig) -> dict[str, str]:
    """Hash what of a capture reaches the training, part by part, so that a difference can be named."""
    views = capture.train_views(config.test_every)
    parts: dict[str, list[Any]] = {"view names": [], "photographs": [], "masks": [], "cameras": [], "sparse points": []}
    for view in views:
        parts["view names"].append(os.fsencode(view.name))
        parts["photographs"].append(view.image)
        parts["masks"].append(b"none" if view.mask is None else view.mask)
        parts["cameras"] += [view.viewmat, view.K]
    parts["sparse points"] = [capture.points, capture.points_rgb]
    if config.random_background:
        parts["alpha channels"] = [b"none" if view.alpha is None else view.alpha for view in views]
    if config.depth_lambda != 0.0:
        parts["tracks"] = [b"none" if view.seen is None else view.seen for view in views]
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
    device: torch.device,
    params: Mapping[str, Parameter],
    optimizers: Mapping[str, Adam],
    state: State,
    moves_moments: bool = True,
) -> tuple[dict[str, Parameter], dict[str, Adam]]:
    """Return parameters and their optimizers on a device; the statistics in `state` are replaced by theirs there.

    Args:
        moves_moments: put the optimizers' moments there, too; otherwise they stay where they are.
    """
    moments = pack_optimizers(optimizers)
    placed = {key: Parameter(params[key].detach().to(device)) for key in KEYS}
    if moves_moments:
        for of in moments.values():
            of.update({name: of[name].to(device) for name in MOMENTS})
    for key, value in state.items():
        state[key] = value.to(device) if isinstance(value, Tensor) else value
    return placed, make_optimizers(placed, moments)


def on_cpu(content: Any) -> Any:
    """Return nested dicts with their tensors on the CPU; those that are there already are not copied."""
    if isinstance(content, Mapping):
        return {key: on_cpu(value) for key, value in content.items()}
    return content.cpu() if isinstance(content, Tensor) else content


_TAILS: Final = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": (15, 3)}
_FLOATS: Final = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
# one row a photograph: exposures, corrections of cameras
_OF_PHOTOGRAPHS: Final = {"exposures": (3, 4), "cameras": (6,)}
_MOMENTS: Final = ("step", *MOMENTS)
_LONGEST: Final = 40  # letters of a value that a message shows
# a strategy's numbers with one row a Gaussian, and their types; None is that of the parameters
_ROWS: Final[Mapping[str, torch.dtype | None]] = {
    **dict.fromkeys(("grad2d", "count", "radii")),
    "blurred": torch.bool,
    "dominant_sum": torch.int64,
}


def check_splats(splats: Any, kind: torch.dtype | None = None, n_rest: int = 15) -> dict[str, Tensor]:
    """Check the raw parameters of a checkpoint.

    Args:
        kind: the type that every tensor must have; None takes any floats, and 0, 3, 8 or 15 coefficients.
        n_rest: coefficients beyond the first band, where a type is given.

    Returns:
        The tensors under `KEYS`, contiguous, of the type `kind` or else float32; others are left out.

    Raises:
        ValueError: a tensor is absent or not finite, has another type or shape, or a quaternion is zero; names it.
    """
    found = _mapping(splats, "splats", KEYS, others=True)
    n: int | None = None
    checked: dict[str, Tensor] = {}
    for key in KEYS:
        name = f"splats.{key}"
        value = _tensor(found[key], name)
        if value.dtype not in (_FLOATS if kind is None else (kind,)):
            wanted = "floats" if kind is None else str(kind)
            raise ValueError(f"{name} is {value.dtype}; it must be a tensor of {wanted}")
        n = len(value) if n is None and value.dim() > 0 else n
        want = [n, *_TAILS[key]]
        if key == "shN":
            free = kind is None and value.dim() == 3 and value.shape[1] in (0, 3, 8)
            want[1] = value.shape[1] if free else n_rest
        bands = " (or 0, 3 or 8 in place of 15)" if key == "shN" and kind is None else ""
        own = _own(value, want, name, bands)
        checked[key] = own.float() if kind is None else own
    bad = first_non_finite(checked) if kind is None else first_unusable(checked)
    if bad:
        raise ValueError(f"splats.{bad[0]}{bad[1]} is {bad[2]}; every entry must be finite")
    turned = checked["quats"].any(1)
    if not turned.all():
        raise ValueError(f"splats.quats[{int(turned.int().argmin())}] is zero; every quaternion must have a norm > 0")
    return checked


def check_content(content: Mapping[str, Any], like: Mapping[str, Tensor] | None = None) -> dict[str, Any]:
    """Check all that a run continues from, except what only the run knows: its settings, its capture, its strategy.

    Args:
        like: as `load_checkpoint`.

    Returns:
        The same with tensors that are contiguous and share no memory.

    Raises:
        ValueError: names the entry, what it is and what it must be.
    """
    step = _whole(content["step"], "step")
    kind, n_rest = (torch.float32, 15) if like is None else (like["means"].dtype, like["shN"].shape[1])
    splats = check_splats(content["splats"], kind, n_rest)
    packed = _mapping(content["optimizers"], "optimizers", KEYS)
    # files of older versions do not have processor time
    seconds = {"cpu": None, **_mapping(content["seconds"], "seconds")}
    _mapping(seconds, "seconds", ("train", "total", "cpu"))
    config = _mapping(content["config"], "config")
    _check_words(config, content["capture"])
    # where the settings do not name it, a step has one view
    drawn = (step + 1) * _whole(config.get("batch_size", 1), "config.batch_size", least=1)
    _whole(content["metrics_bytes"], "metrics_bytes")
    _whole(content["threads"], "threads", least=1)
    checked = {
        **content,
        "splats": splats,
        "optimizers": {key: _moments(packed[key], f"optimizers.{key}", splats[key], step + 1) for key in KEYS},
        "strategy": _strategy(content["strategy"], splats["shN"], drawn),
        "view_order": _view_order(content["view_order"]),
        "appearance": _appearance(content.get("appearance", {}), step + 1, kind),
        "seconds": {
            key: None if key == "cpu" and value is None else _number(value, f"seconds.{key}")
            for key, value in seconds.items()
        },
    }
    tensors = {name: checked[name] for name in ("splats", "optimizers", "strategy", "view_order", "appearance")}
    _check_apart(tensors, "", {})
    return checked


def _appearance(packed: Any, taken: int, kind: torch.dtype) -> dict[str, dict[str, Tensor]]:
    """Check what was learned of the photographs; files of older versions have none."""
    checked: dict[str, dict[str, Tensor]] = {}
    for key, found in _mapping(packed, "appearance").items():
        if key not in _OF_PHOTOGRAPHS:
            raise ValueError(f"appearance.{shown(key)} is unknown; it must hold {', '.join(_OF_PHOTOGRAPHS)}")
        name = f"appearance.{key}"
        moments = dict(_mapping(found, name, ("value", *_MOMENTS)))
        value = _tensor(moments.pop("value"), f"{name}.value", kind)
        own = _own(value, [*value.shape[:1], *_OF_PHOTOGRAPHS[key]], f"{name}.value")
        bad = first_non_finite({f"{name}.value": own})
        if bad:
            raise ValueError(f"{bad[0]}{bad[1]} is {bad[2]}; every entry must be finite")
        checked[key] = {"value": own, **_moments(moments, name, own, taken)}
    return checked


def _moments(packed: Any, name: str, param: Tensor, taken: int) -> dict[str, Tensor]:
    found = _mapping(packed, name, _MOMENTS)
    like = list(param.shape)
    checked = {"step": _own(_tensor(found["step"], f"{name}.step", torch.float32), [], f"{name}.step")}
    counted = float(checked["step"])
    if not (0 <= counted <= taken and counted.is_integer()):
        most = f"a whole number of updates, at most {taken}, the steps taken"
        raise ValueError(f"{name}.step is {checked['step'].item():g}; it must be {most}")
    for key in _MOMENTS[1:]:
        checked[key] = _own(_tensor(found[key], f"{name}.{key}", param.dtype), like, f"{name}.{key}")
    bad = first_non_finite({"exp_avg": checked["exp_avg"]})
    if bad:
        raise ValueError(f"{name}.exp_avg{bad[1]} is {bad[2]}; every entry must be finite")
    _check_not_negative(checked["exp_avg_sq"], f"{name}.exp_avg_sq")
    return checked


def _strategy(packed: Any, sh_rest: Tensor, drawn: int) -> dict[str, Any]:
    found = _mapping(packed, "strategy", ("generator",), others=True)
    checked = {**found, "generator": _generator(found["generator"], "strategy.generator")}
    if "views" in found:
        _whole(found["views"], "strategy.views", most=drawn)
    if "first_count" in found:
        _whole(found["first_count"], "strategy.first_count")
    if "scene_scale" in found:
        checked["scene_scale"] = _number(found["scene_scale"], "strategy.scene_scale")
    for key in _ROWS.keys() & found.keys():
        if found[key] is not None:
            value = _tensor(found[key], f"strategy.{key}", _ROWS[key] or sh_rest.dtype)
            checked[key] = _own(value, [len(sh_rest)], f"strategy.{key}")
            if checked[key].dtype != torch.bool:
                _check_not_negative(checked[key], f"strategy.{key}")
    for key in found.keys() - _ROWS.keys() - {"generator", "views", "scene_scale", "sh_rest_sum"}:
        # of a strategy of other people
        name = shown(key).strip("'")
        checked[key] = _plain(found[key], f"strategy.{name}")
    if found.get("sh_rest_sum") is not None:
        waiting = _tensor(found["sh_rest_sum"], "strategy.sh_rest_sum", sh_rest.dtype)
        checked["sh_rest_sum"] = _own(waiting, list(sh_rest.shape), "strategy.sh_rest_sum")
    if (found.get("grad2d") is None) != (found.get("count") is None):
        raise ValueError("strategy.grad2d and strategy.count must both be tensors or both be None")
    return checked


def _plain(value: Any, name: str) -> Any:
    """Check that a value is a plain one or a tensor of plain memory on the CPU."""
    if isinstance(value, (str, int, float, bool, type(None))):
        return value
    if not isinstance(value, Tensor):
        raise ValueError(f"{name} is {shown(value)}; it must be a plain value or a tensor")
    found = _tensor(value, name)
    return _own(found, list(found.shape), name)


def _view_order(packed: Any) -> dict[str, Any]:
    found = _mapping(packed, "view_order", ("generator", "order", "position"))
    order = found["order"]
    if not isinstance(order, list) or not all(type(view) is int for view in order):
        raise ValueError(f"view_order.order is {shown(order)}; it must be a list of whole numbers")
    if sorted(order) != list(range(len(order))):
        raise ValueError("view_order.order must hold every view once")
    position = _whole(found["position"], "view_order.position", most=len(order))
    return {"generator": _generator(found["generator"], "view_order.generator"), "order": order, "position": position}


def _generator(value: Any, name: str) -> Tensor:
    fresh = torch.Generator()
    state = _own(_tensor(value, name, torch.uint8), list(fresh.get_state().shape), name)
    try:
        fresh.set_state(state)
    except RuntimeError as error:
        raise ValueError(f"{name} is not the state of a random generator") from error
    return state


def _check_words(config: Mapping[Any, Any], capture: Any) -> None:
    """Check what is compared with a run's settings and capture: only plain values can be compared and shown."""
    plain = (str, int, float, bool, type(None))
    for key, value in config.items():
        values = value if isinstance(value, (list, tuple)) else [value]
        if type(key) is not str or not all(type(item) in plain for item in values):
            raise ValueError(f"config.{shown(key)} is {shown(value)}; it must be a plain value")
    for key, value in _mapping(capture, "capture").items():
        if type(key) is not str or type(value) is not str:
            raise ValueError(f"capture.{shown(key)} is {shown(value)}; it must be a text")


def _mapping(value: Any, name: str, keys: tuple[str, ...] | None = None, others: bool = False) -> Mapping[Any, Any]:
    """Return a value that is a dict with these keys (None: any), and no others unless they are allowed."""
    if not isinstance(value, dict):
        raise ValueError(f"{name} is {shown(value)}; it must be a dict")
    for key in keys or ():
        if key not in value:
            raise ValueError(f"has no {name}.{key}")
    odd = [] if keys is None or others else [key for key in value if key not in keys]
    if odd:
        raise ValueError(f"{name}.{shown(odd[0])} is unknown; it must hold {', '.join(keys or ())}")
    return value


def _tensor(value: Any, name: str, kind: torch.dtype | None = None) -> Tensor:
    """Return a value that is a tensor of plain memory on the CPU, of the type `kind` (None: any)."""
    wanted = "a tensor of floats" if kind is None else f"a tensor of {str(kind).removeprefix('torch.')}"
    if type(value) not in (Tensor, Parameter):
        raise ValueError(f"{name} is {shown(value)}; it must be {wanted}")
    if value.layout != torch.strided or value.is_nested or value.is_quantized or value.device.type != "cpu":
        raise ValueError(f"{name} is not a plain array of numbers on the CPU; it must be {wanted}")
    if kind not in (None, value.dtype):
        raise ValueError(f"{name} is {value.dtype}; it must be {wanted}")
    return value.detach()


def _own(value: Tensor, shape: list[Any], name: str, hint: str = "") -> Tensor:
    """Return a tensor that has this shape, copied where it is a view of other numbers than its own."""
    if list(value.shape) != shape:
        raise ValueError(f"{name} has shape {list(value.shape)}; it must be {str(shape).replace('None', 'N')}{hint}")
    size, held = value.numel() * value.element_size(), value.untyped_storage().nbytes()
    if size > held:
        raise ValueError(f"{name} has {size} bytes, of which the file holds {held}; it must hold every number")
    if value.dtype == torch.bool and size and value.contiguous().view(torch.uint8).max() > 1:
        raise ValueError(f"{name} holds what is neither true nor false")
    if size == held and value.is_contiguous() and not value.is_neg():
        return value
    return torch.empty(shape, dtype=value.dtype).copy_(value)


def _check_apart(value: Any, name: str, seen: dict[int, str]) -> None:
    """Raise ValueError when two tensors share memory: a change of one would change the other."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            _check_apart(item, f"{name}.{key}" if name else str(key), seen)
    elif isinstance(value, Tensor) and value.numel() > 0:
        other = seen.setdefault(value.untyped_storage().data_ptr(), name)
        if other != name:
            raise ValueError(f"{name} and {other} are the same memory; each must have its own")


def _check_not_negative(value: Tensor, name: str) -> None:
    # the smallest of numbers with a NaN among them is NaN, which is not >= 0 either
    if value.numel() == 0 or value.min() >= 0:
        return
    index = [int(i) for i in torch.nonzero(~(value >= 0))[0]]
    raise ValueError(f"{name}{index} is {value[tuple(index)].item()}; every entry must be at least 0")


def _whole(value: Any, name: str, least: int = 0, most: int = 2**53) -> int:
    if type(value) is not int or not least <= value <= most:
        limit = f"at least {least}" if most == 2**53 else f"from {least} to {most}"
        raise ValueError(f"{name} is {shown(value)}; it must be a whole number, {limit}")
    return value


def _number(value: Any, name: str) -> float:
    if type(value) not in (int, float) or not 0 <= value < math.inf:
        raise ValueError(f"{name} is {shown(value)}; it must be a finite number, at least 0")
    return value


def shown(value: Any) -> str:
    """Show a plain value, shortened, or tell the kind of any other."""
    if isinstance(value, int) and abs(value) > 2**63:
        return "a number beyond 2^63"
    if isinstance(value, (str, int, float, type(None))):
        text = repr(value)
        return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
    return type(value).__name__
