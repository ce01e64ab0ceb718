"""Which backend a run is done by."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from pop_fast.api.backend import Backend, by_speed, get_backend
from pop_fast.errors import PopError
from pop_fast.train.config import TrainConfig
from pop_fast.train.steps import why_not_trained


def choose_backend(config: TrainConfig, resume: bool = False) -> tuple[TrainConfig, str]:
    """Settle backend "auto": the fastest that can run here and knows the settings, a GPU's before a CPU's.

    A resumed run keeps the backend that it was begun with.

    Returns:
        The settings with a backend's name, and one line that says which and why.
    """
    chosen, why = _choose(config, resume)
    step = get_backend(chosen.backend).whole_step()
    unknown = None if step is None else next(step.unknown(chosen), None)
    if unknown is None or get_backend(chosen.backend).device != "cpu":
        return chosen, why
    setting, value, _ = unknown
    return chosen, f"{why}; its fused step does not take {setting} = {value}, so autograd is used"


def _choose(config: TrainConfig, resume: bool) -> tuple[TrainConfig, str]:
    if config.backend != "auto":
        return config, f"backend {config.backend}, as requested"
    begun = _begun_with(Path(config.result_dir)) if resume else None
    if begun is not None:
        try:
            return replace(config, backend=begun), f"backend {begun}, with which the run was begun"
        except PopError:
            from pop_fast.train.results import read_config

            # raises one that names the file, and the package that gave the backend
            read_config(Path(config.result_dir))
            raise
    reasons: list[str] = []
    for backend in by_speed():
        reason = _why_not(backend, config)
        if reason is not None:
            # the one that comes closest first
            reasons.insert(0, reason)
            continue
        on_cpu = backend.device == "cpu"
        why = "; ".join(reasons) if on_cpu else "there is a GPU, and the extension is built"
        return replace(config, backend=backend.name), f"backend {backend.name}{' (CPU)' if on_cpu else ''}: {why}"
    raise PopError("; ".join(reasons))


def _why_not(backend: Backend, config: TrainConfig) -> str | None:
    """Return why a backend does not take the steps of a run here, or None."""
    reason = backend.why_not()
    if reason is None:
        return why_not_trained(backend, config)
    return "there is no NVIDIA GPU here" if backend.device == "cuda" and not has_gpu() else reason


def on_gpu(config: TrainConfig) -> bool:
    """Tell whether a run's backend, once it is settled, trains on a GPU."""
    return config.backend != "auto" and get_backend(config.backend).device != "cpu"


# what torchrun tells every process that it starts
LAUNCHED: Final = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")


def is_launched() -> bool:
    """Tell whether a launcher started this process together with others; one variable left in a shell does not."""
    return all(os.environ.get(name) for name in LAUNCHED) and os.environ["WORLD_SIZE"] != "1"


def local_rank() -> int:
    """Return which process of this machine this is, from 0: LOCAL_RANK, else RANK; PopError where that is no number."""
    name = next((name for name in ("LOCAL_RANK", "RANK") if os.environ.get(name)), None)
    said = "0" if name is None else os.environ[name]
    if not (said.isascii() and said.isdigit()):
        raise PopError(f"{name} is {said!r}; it must be the number of this process, from 0: start them with torchrun")
    return int(said)


def check_gpus(config: TrainConfig, processes: int = 1) -> str | None:
    """Settle which GPUs of this machine a run uses.

    Args:
        processes: that train together, of which LOCAL_WORLD_SIZE run here where a launcher says so.

    Returns:
        A line on GPUs that are left idle, and how they would be used; None where there are none.

    Raises:
        PopError: this process has no GPU of its own.
    """
    if get_backend(config.backend).device != "cuda":
        return None
    count, rank = count_gpus(), local_rank() if processes > 1 else 0
    if rank >= count > 0:
        raise PopError(
            f"process {rank} of this machine has no GPU of its own, because there {_are(count)}; start one process a "
            f"GPU (--nproc-per-node {count}), or train on CPUs (--backend fast)"
        )
    here = os.environ.get("LOCAL_WORLD_SIZE", "") if processes > 1 else "1"
    used = int(here) if here.isdigit() else processes
    if used >= count:
        return None
    return (
        f"{used} of {count} GPUs {'is' if used == 1 else 'are'} used; torchrun --nproc-per-node {count} --no-python "
        f"pop train ... --batch-size {count} uses all, for steps of {count} views"
    )


def _are(count: int) -> str:
    return "is 1" if count == 1 else f"are {count}"


def count_gpus() -> int:
    """Return how many GPUs this process may use."""
    import torch

    return torch.cuda.device_count()


def has_gpu() -> bool:
    """Tell whether the system shows an NVIDIA GPU: its driver's devices, or on WSL the host's."""
    return any(Path(device).exists() for device in ("/dev/nvidiactl", "/dev/nvidia0", "/dev/dxg")) or os.name == "nt"


def _begun_with(folder: Path) -> Any:
    """Return the backend of the run in a folder, or None where there is none or its settings cannot be read."""
    path = folder / "cfg.json"
    try:
        return json.loads(path.read_text(encoding="utf-8"))["resolved"]["backend"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
