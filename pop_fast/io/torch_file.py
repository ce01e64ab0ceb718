"""Read what `torch.save` wrote, once every byte of it has been held against its checksum."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import torch

from pop_fast.errors import PopError

__all__ = ["read_torch_file"]


def read_torch_file(path: Path, fix: str) -> Any:
    """Read tensors and plain values on the CPU; loading them cannot run code.

    `torch.save` writes a zip whose members carry CRC-32 checksums, and torch's own reader skips these: a flipped bit in
    a tensor would be read as another number.

    Args:
        path: the file.
        fix: what to do about a damaged file, for the message.

    Raises:
        PopError: the file is absent, cannot be read, or is damaged.
    """
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
    """Say what is wrong with a zip of stored members, or None.

    Raises:
        Exception: of many kinds, when it is not a zip or the list of its members is damaged.
    """
    with zipfile.ZipFile(file) as archive:
        for member in archive.infolist():
            # torch.save never compresses; what does may come to any number of bytes when it is read
            if member.compress_type != zipfile.ZIP_STORED:
                return f"{member.filename} in it is compressed, which torch.save never does"
        bad = archive.testzip()
    return f"{bad} in it does not agree with its checksum" if bad else None
