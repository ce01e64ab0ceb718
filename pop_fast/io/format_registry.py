"""The formats that splats are written in, by name; to list them imports none.

Another package declares a `pop_fast.io.formats.Format` of its own under the entry point group `pop_splatting.formats`,
or calls `FORMATS.register`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from pop_fast.errors import PopError
from pop_ref.registry import Registry

if TYPE_CHECKING:
    from pop_fast.io.formats.table import Format

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


def format_names() -> tuple[str, ...]:
    """Return the names of all formats, PLY first."""
    return (PLY, *FORMATS)
