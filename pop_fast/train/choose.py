"""Which backend a run is done by."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

from pop_fast.api.registry import get_backend
from pop_fast.errors import PopError
from pop_fast.train.config import TrainConfig
from pop_fast.train.fused_settings import unsupported, unsupported_setting


def choose_backend(config: TrainConfig, resume: bool = False) -> tuple[TrainConfig, str]:
    """Settle backend "auto": "cuda" where a GPU, the build and the settings allow it, else "compiled" or "fast".

    A run that is gone on with keeps the backend that it was begun with.

    Args:
        config: the settings as given.
        resume: continue with the run in `config.result_dir`, if there is one.

    Returns:
        The settings with a backend's name, and one line that says which and why.
    """
    chosen, why = _choose(config, resume)
    name = unsupported_setting(chosen) if chosen.backend == "compiled" else None
    return chosen, why if name is None else f"{why}; its fused step has no {name}, so autograd takes the steps"


def _choose(config: TrainConfig, resume: bool) -> tuple[TrainConfig, str]:
    if config.backend != "auto":
        return config, f"backend {config.backend}, as asked for"
    begun = _begun_with(Path(config.result_dir)) if resume else None
    if begun is not None:
        try:
            return replace(config, backend=begun), f"backend {begun}, with which the run was begun"
        except PopError as error:
            path = Path(config.result_dir) / "cfg.json"
            raise PopError(f"{path}: {error}; repair the file, copy it again or train again") from error
    reason = get_backend("cuda").why_not()
    if reason is not None and not has_gpu():
        reason = "there is no NVIDIA GPU here"
    if reason is None:
        reason = unsupported(config)
    if reason is None:
        return replace(config, backend="cuda"), "backend cuda: a GPU and the build are here"
    not_compiled = get_backend("compiled").why_not()
    if not_compiled is None:
        return replace(config, backend="compiled"), f"backend compiled (CPU): {reason}"
    return replace(config, backend="fast"), f"backend fast (CPU): {not_compiled}; {reason}"


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
