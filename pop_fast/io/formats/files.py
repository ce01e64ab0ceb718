"""Write and read files of splats by the name of the format, or by the file's name."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from pop_fast.errors import PopError
from pop_fast.io.atomic import write_file
from pop_fast.io.formats import FORMATS, PLY, format_names, sog
from pop_fast.io.formats.cloud import Cloud
from pop_fast.io.formats.compressed_ply import is_compressed
from pop_fast.io.formats.table import READ_ONLY
from pop_fast.io.ply import Frame, asks_for_antialiasing, file_bytes, header_of, params_of_ply, ply_bytes


class Stored(NamedTuple):
    """What a file holds."""

    params: dict[str, Tensor]  # raw parameters, as `pop_fast.io.ply.load_ply` returns them
    antialiased: bool  # to be drawn with antialiasing
    frame: Frame | None  # the world that they are in, where the file says it


def splat_suffixes() -> tuple[str, ...]:
    """Return the suffixes of all formats that are written, without repetition, the longest first."""
    found = dict.fromkeys([".ply", *(format.suffix for _, format in FORMATS.usable())])
    return tuple(sorted(found, key=len, reverse=True))


def readable_names() -> tuple[str, ...]:
    """Return how the names of files end that are read, in alphabetical order."""
    return tuple(sorted([*splat_suffixes(), *READ_ONLY, sog.META]))


def is_splat_file(path: Path) -> bool:
    """Tell whether a name ends as one of the formats' do that are read."""
    return path.name.lower().endswith(readable_names())


def default_name(stem: str, name: str) -> str:
    """Return the name of a file in a format, if it is not given: no two formats share one."""
    return f"{stem}.ply" if name == PLY else f"{stem}{FORMATS[name].mark}{FORMATS[name].suffix}"


def loses_frame(name: str, frame: Frame | None) -> bool:
    """Tell whether a file in a format does not say its world, and what is taken for it is another one."""
    return frame is not None and frame.name != "capture" and not _has_frame(name)


def loses_settings(name: str, frame: Frame | None) -> bool:
    """Tell whether a file in a format does not say by which settings it is drawn, and these are not the usual ones."""
    return frame is not None and bool(frame.drawn) and not _has_frame(name)


def _has_frame(name: str) -> bool:
    return name == PLY or FORMATS[name].has_frame


def named_format(path: Path, to: str | None = None) -> str:
    """Return the format that a file is to be written in: the one that is asked for, or the one of its suffix.

    Raises:
        PopError: neither says, or the suffix is another format's.
    """
    name = path.name.lower()
    if path.suffix.lower() in READ_ONLY or name == sog.META:
        raise PopError(f"{path}: is of a format that is read and not written; choose .sog or another")
    suffix = next((s for s in splat_suffixes() if name.endswith(s)), None)
    by_suffix = [PLY] if suffix == ".ply" else [key for key, format in FORMATS.usable() if format.suffix == suffix]
    if to is None:
        if not by_suffix:
            raise PopError(f"{path}: the name must end in one of {', '.join(sorted(splat_suffixes()))}, or give --to")
        return by_suffix[0]
    if to not in format_names():
        raise PopError(f"--to {to}: no such format; it is one of {', '.join(format_names())}")
    if by_suffix and to not in by_suffix:
        wanted = ".ply" if to == PLY else FORMATS[to].suffix
        raise PopError(f"{path}: ends in {suffix}, which is not how files of {to} end; name it *{wanted}")
    return to


def levels(name: str) -> int:
    """Return how many levels of coarseness a format is written at."""
    return 1 if name == PLY else len(FORMATS[name].encoders)


def encoded(
    name: str,
    params: Mapping[str, Tensor],
    antialiased: bool = False,
    frame: Frame | None = None,
    level: int = 0,
) -> bytes:
    """Return a splat as a file's bytes.

    Args:
        name: of the format.
        params: raw parameters, as for `pop_fast.io.ply.save_ply`.
        antialiased: to be drawn with antialiasing.
        frame: the world that they are in, where it is known; `.splat` has no room for it.
        level: how coarsely view dependence is written, from 0, less than `levels(name)`.

    Raises:
        PopError: a parameter is absent, of the wrong shape, NaN or Inf, or the format cannot hold it.
    """
    if name == PLY:
        return ply_bytes(dict(params), antialiased, frame)
    format, cloud = FORMATS[name], Cloud.of(params, antialiased, frame)
    return format.encoders[level](cloud if format.order is None else cloud.take(format.order(cloud)))


def decoded(name: str, data: bytes, path: Path = Path("memory")) -> Stored:
    """Read a splat of a format from a file's bytes, whose errors name `path`."""
    if name == PLY:
        params, header = params_of_ply(data, path), header_of(data, path)
        return Stored(params, asks_for_antialiasing(header), Frame.of_comments(header.comments, path))
    return _stored(FORMATS[name].decode(data, path))


def _stored(cloud: Cloud) -> Stored:
    return Stored(cloud.params(), cloud.antialiased, cloud.frame)


def save_as(
    path: str | os.PathLike[str],
    name: str,
    params: Mapping[str, Tensor],
    antialiased: bool = False,
    frame: Frame | None = None,
) -> int:
    """Write a splat in a format, atomically; returns the number of bytes."""
    data = encoded(name, params, antialiased, frame)
    write_file(path, data)
    return len(data)


def load_splat_file(path: str | os.PathLike[str]) -> Stored:
    """Read a splat in any format from its file; for SOG in a folder from that folder, or its meta.json.

    Raises:
        PopError: the file is absent, of an unknown kind or damaged; names the field.
    """
    path = Path(path)
    if path.is_dir():
        if not (path / sog.META).is_file():
            raise PopError(f"{path}: is a folder without SOG's meta.json; 'pop export' reads the folder of a training")
        path = path / sog.META
    suffix = path.suffix.lower()
    if path.name.lower() == sog.META:
        return _stored(sog.decode_folder(path))
    if suffix in READ_ONLY:
        return _stored(READ_ONLY[suffix](file_bytes(path), path))
    if not is_splat_file(path):
        raise PopError(f"{path}: the name must end in one of {', '.join(readable_names())}")
    name = named_format(path)
    if name in (PLY, "compressed-ply"):
        # either may stand under the name of the other
        name = "compressed-ply" if is_compressed(path) else PLY
    return decoded(name, file_bytes(path), path)
