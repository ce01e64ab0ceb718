"""File formats of splats: PlayCanvas's compressed PLY and SOG, Niantic's SPZ, `.splat`, glTF, and KSPLAT to read.

To list their names imports none of them. Another package declares a `Format` of its own under the entry point group
`pop_splatting.formats`, or calls `FORMATS.register`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from pop_fast.errors import PopError
from pop_fast.lazy import given_by
from pop_ref.registry import Registry

if TYPE_CHECKING:
    from pop_fast.io.formats.files import (
        Stored,
        decoded,
        default_name,
        encoded,
        is_splat_file,
        levels,
        load_splat_file,
        loses_frame,
        loses_settings,
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
    "loses_settings",
    "named_format",
    "readable_names",
    "save_as",
    "splat_suffixes",
]

# gsplat's and Inria's own format, which is no entry of the table: its rows are the parameters as they are trained
PLY: Final = "ply"
FORMATS: Final[Registry[Format]] = Registry(
    "format",
    "pop_splatting.formats",
    {
        "compressed-ply": "pop_fast.io.formats.table:COMPRESSED_PLY",
        "spz": "pop_fast.io.formats.table:SPZ",
        "spz-4": "pop_fast.io.formats.table:SPZ_4",
        "sog": "pop_fast.io.formats.table:SOG",
        "splat": "pop_fast.io.formats.table:SPLAT",
        "gltf": "pop_fast.io.formats.table:GLTF",
        "gltf-spz": "pop_fast.io.formats.table:GLTF_SPZ",
    },
    needs=("name", "suffix", "title", "encode", "decode", "order", "mark", "has_frame"),
    error=PopError,
)
_OWN: Final = ("FORMATS", "PLY", "Format", "format_names")
__getattr__ = given_by(__name__, {"table": ("Format",), "files": tuple(name for name in __all__ if name not in _OWN)})


def format_names() -> tuple[str, ...]:
    """Return the names of all formats, PLY first."""
    return (PLY, *FORMATS)
