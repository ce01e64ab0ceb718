"""File formats of splats: PlayCanvas's compressed PLY and SOG, Niantic's SPZ, `.splat`, glTF, and KSPLAT to read."""

from pop_fast.io.formats.files import (
    PLY,
    Stored,
    decoded,
    default_name,
    encoded,
    format_names,
    is_splat_file,
    load_splat_file,
    loses_frame,
    named_format,
    readable_names,
    save_as,
    splat_suffixes,
)
from pop_fast.io.formats.table import FORMATS, Format

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
    "load_splat_file",
    "loses_frame",
    "named_format",
    "readable_names",
    "save_as",
    "splat_suffixes",
]
