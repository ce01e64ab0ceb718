"""File formats of splats: PlayCanvas's compressed PLY and SOG, Niantic's SPZ, `.splat`, glTF, and KSPLAT to read."""

from pop_fast.io.format_registry import FORMATS, PLY, format_names
from pop_fast.io.formats.files import (
    Stored,
    decoded,
    default_name,
    encoded,
    is_splat_file,
    levels,
    load_splat_file,
    loses_frame,
    named_format,
    readable_names,
    save_as,
    splat_suffixes,
)
from pop_fast.io.formats.table import Format

__all__ = [
    "FORMATS",
    "PLY",
    "Format",
    "Stored",
    "decoded",
    "default_name",
    "encoded",
    "format_names",
    "is_splat_file",
    "levels",
    "load_splat_file",
    "loses_frame",
    "named_format",
    "readable_names",
    "save_as",
    "splat_suffixes",
]
