"""File formats of splats beside PLY: PlayCanvas's compressed PLY and SOG, Niantic's SPZ, `.splat` and glTF."""

from pop_fast.io.formats.files import (
    PLY,
    decoded,
    encoded,
    format_names,
    is_splat_file,
    load_splat_file,
    named_format,
    save_as,
    splat_suffixes,
)
from pop_fast.io.formats.table import FORMATS, Format

__all__ = [
    "FORMATS",
    "PLY",
    "Format",
    "decoded",
    "encoded",
    "format_names",
    "is_splat_file",
    "load_splat_file",
    "named_format",
    "save_as",
    "splat_suffixes",
]
