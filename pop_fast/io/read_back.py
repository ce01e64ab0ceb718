"""Read what a run has written (JSON, arrays, checkpoints) and may be damaged, and judge what memory a file may take.

A few kilobytes can state any size, and deflate makes a thousand bytes of one. What a reader will need is known from
headers: counts, widths and heights, sizes of members. It may be a little at any rate, and beyond that so many times
the file as no real one needs; and it must be free.
"""

from __future__ import annotations

import json
import math
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_fast.errors import PopError
from pop_fast.machine import free_bytes

# what helps where the file of a splat is damaged
WRITE_AGAIN: Final = "copy or write the file again"
_TEXTS: Final = frozenset({"method", "capture", "machine", "backend", "lpips_net", "lpips_reason", "view"})
_NUMBERS: Final = frozenset(
    {
        *("step", "num_GS", "num_GS_above_floor", "opacity_below_0.1", "opacity_above_0.9", "psnr", "ssim", "lpips"),
        *("n_blended", "n_traversed", "views", "threads", "seconds", "seconds_total", "seconds_loading", "seconds_sfm"),
        *("seconds_cpu", "lambda_pop", "blur_min_pixels", "blur_events", "seed", "max_steps"),
        *("memory_bytes", "mem", "ellipse_time", "loss", "pop", "num_gaussians", "cloned", "split", "pruned"),
    }
)
_COUNTS: Final = frozenset({"num_GS", "num_GS_above_floor", "views", "threads", "num_gaussians"})
# what is drawn is squared, and its logarithm taken and undone
_LARGEST: Final = 1e150


def read_json(path: Path, fix: str) -> dict[str, Any]:
    """Read a JSON file that holds an object; a PopError that it does not, or cannot be read, ends in `fix`."""
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise PopError(f"{path}: is not JSON ({error}); {fix}") from error
    content = parse_json(text, f"{path}:", fix)
    if not isinstance(content, dict):
        raise PopError(f"{path}: holds {type(content).__name__}; it must be an object; {fix}")
    return content


def parse_json(text: str, where: str, fix: str) -> Any:
    """Parse JSON; a PopError says that it is none, or nested deeper or with longer numbers than Python reads."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise PopError(f"{where} is not JSON ({error}); {fix}") from error


def check_record(record: Any, where: str, fix: str, needed: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return a record of statistics whose known entries are what a run writes; a PopError names another one."""
    if not isinstance(record, dict):
        raise PopError(f"{where}: holds {type(record).__name__}; it must be an object; {fix}")
    for key in needed:
        if record.get(key) is None:
            raise PopError(f"{where}: has no {key}; {fix}")
    for key, value in record.items():
        if value is None:
            continue
        if key in _TEXTS and not isinstance(value, str):
            raise PopError(f"{where}: {key} is {_shown(value)}; it must be a text; {fix}")
        if key in _NUMBERS and not _is_number(value, whole=key in needed):
            raise PopError(f"{where}: {key} is {_shown(value)}; it must be a number; {fix}")
        if key in _COUNTS and not math.isfinite(float(value)):
            raise PopError(f"{where}: {key} is {_shown(value)}; it must be finite; {fix}")
        if key == "versions" and not isinstance(value, dict):
            raise PopError(f"{where}: {key} is {_shown(value)}; it must be an object; {fix}")
    return record


def _is_number(value: Any, whole: bool) -> bool:
    if whole or isinstance(value, int):
        return type(value) is int and abs(value) <= _LARGEST
    return isinstance(value, float) and not _LARGEST < abs(value) < math.inf


def _shown(value: Any) -> str:
    text = repr(value) if isinstance(value, (str, float, bool)) else type(value).__name__
    return text if len(text) <= 40 else f"{text[:40]}..."


def read_arrays(path: Path, forms: Mapping[str, tuple[str, int]], fix: str) -> dict[str, np.ndarray]:
    """Read arrays from an .npz file; a PopError names one that is absent or of another form, and ends in `fix`.

    Args:
        path: the file.
        forms: by name the kinds that an array may have, as in `numpy.dtype.kind`, and how many axes it has; a name with
            a "?" behind it may be absent.
        fix: what to do about a damaged file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            check_members(path, archive, path.stat().st_size, fix)
        with np.load(path, allow_pickle=False) as stored:
            # what is no array in such a file is bytes
            arrays = {name: np.asarray(stored[name]) for name in stored.files if name in forms or f"{name}?" in forms}
    except PopError:
        raise
    # a damaged zip ends in errors of many kinds
    except Exception as error:
        raise PopError(f"{path}: is damaged ({error}); {fix}") from error
    for name, (kinds, axes) in forms.items():
        found = arrays.get(name.removesuffix("?"))
        if found is None and name.endswith("?"):
            continue
        if found is None or found.dtype.kind not in kinds or found.ndim != axes or found.size == 0:
            what = "absent" if found is None else f"{found.dtype} {list(found.shape)}"
            raise PopError(f"{path}: {name.removesuffix('?')} is {what}, which no run writes; {fix}")
    return arrays


def read_torch_file(path: Path, fix: str) -> Any:
    """Read tensors and plain values on the CPU; loading them cannot run code.

    `torch.save` writes a zip whose members carry CRC-32 checksums, and torch's own reader skips these: a flipped bit in
    a tensor would be read as another number.

    Raises:
        PopError: the file is absent, cannot be read, or is damaged; ends in `fix`.
    """
    import torch

    try:
        with open(path, "rb") as file:
            damage = _damage(file)
        content = None if damage else torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise PopError(f"{path}: there is no such checkpoint; check the path") from None
    except PermissionError as error:
        raise PopError(f"{path}: permission denied; change its owner or mode") from error
    except Exception as error:
        raise PopError(f"{path}: cannot be read as a checkpoint; {fix}") from error
    if damage:
        raise PopError(f"{path}: cannot be read as a checkpoint: {damage}; {fix}")
    return content


def _damage(file: Any) -> str | None:
    """Say what is wrong with a zip of stored members, or None; errors of many kinds come where it is none."""
    with zipfile.ZipFile(file) as archive:
        for member in archive.infolist():
            # torch.save never compresses; what does may come to any number of bytes when it is read
            if member.compress_type != zipfile.ZIP_STORED:
                return f"{member.filename} in it is compressed, which torch.save never does"
        bad = archive.testzip()
    return f"{bad} in it does not agree with its checksum" if bad else None


# what any file may need, bytes, and any picture: one of a single colour packs well, and 89 million pixels are read
_ANY: Final = 2**26
PICTURE: Final = 2**29
# times the file's size; splats that pack well need 60
_MOST_TIMES: Final = 200


def check_memory(
    path: Path | str, needed: int, packed: int, what: str, fix: str, floor: int = _ANY, disk: Path | None = None
) -> None:
    """Refuse what needs more memory than its file makes likely, or than there is; a PopError names both sizes in MB.

    Args:
        path: the file, for the error.
        needed: bytes, by what the file states.
        packed: the file's own bytes.
        what: states it, for the error.
        fix: what to do, for the error.
        floor: bytes that are always likely.
        disk: a folder on the disk that it is written to piece by piece, and which has to have room in place of memory.
    """
    if needed <= _ANY:
        return
    takes = f"{path}: {what} would take {_mb(needed)} of {'memory to read' if disk is None else 'the disk'}"
    if needed > max(floor, _MOST_TIMES * packed):
        raise PopError(f"{takes}, and the file has {_mb(packed)}, too little for such content; {fix}")
    free = free_bytes() if disk is None else shutil.disk_usage(disk).free
    if free is not None and needed > free:
        raise PopError(f"{takes}, and {_mb(free)} are free; {fix}")


def check_members(path: Path | str, archive: zipfile.ZipFile, packed: int, fix: str, disk: Path | None = None) -> None:
    """Refuse a zip whose members would come to too much; see `check_memory`."""
    members = archive.infolist()
    if members:
        largest = max(members, key=lambda member: member.file_size)
        needed = sum(member.file_size for member in members)
        check_memory(path, needed, packed, f"{largest.filename[:80]!r} and what else is in it", fix, disk=disk)


def _mb(size: int) -> str:
    return f"{size / 1e6:,.1f} MB"
