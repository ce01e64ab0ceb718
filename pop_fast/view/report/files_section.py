"""The report's sections on what leaves the result folder: the splat in a viewer, and its size in every file format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, Final

from pop_fast.errors import PopError
from pop_fast.view.document import asset

# a page that is larger than this is linked, not put into the report
_LARGEST: Final = 16 * 2**20
_KINDS: Final[Mapping[str, tuple[type, ...]]] = {
    "format": (str,),
    "bytes": (int,),
    "num_gaussians": (int,),
    "psnr": (int, float, type(None)),
    "views": (int,),
}


def checked_encodings(entries: Any, where: str, fix: str) -> list[dict[str, Any]]:
    """Check the entry `encodings` of the statistics.

    Raises:
        PopError: it is not what `pop train` writes; names the entry.
    """
    if not isinstance(entries, list):
        raise PopError(f"{where}: encodings is {type(entries).__name__}; it must be a list; {fix}")
    for index, entry in enumerate(entries):
        wrong = [
            name
            for name, kinds in _KINDS.items()
            if not isinstance(entry, dict) or name not in entry or not isinstance(entry[name], kinds)
        ]
        if wrong:
            raise PopError(f"{where}: encodings[{index}].{wrong[0]} is absent or of the wrong kind; {fix}")
    return entries


def encoding_heads(encodings: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Return the heads of a table of encodings; few of many held-out views are rendered, and the last head says so."""
    views = max((entry["views"] for entry in encodings), default=0)
    return "format", "MB", "B/Gaussian", "of the PLY", f"PSNR of {views} held-out view{'' if views == 1 else 's'}"


def encoding_rows(encodings: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Return the cells of a table of encodings, under `encoding_heads`.

    Args:
        encodings: entries of the statistics, as `pop_fast.train.encodings.Encoding` makes them.

    Returns:
        A row a format: its name, MB, bytes a Gaussian, size as a share of the PLY's, PSNR and how far it is from the
        PLY's.
    """
    whole = next((entry for entry in encodings if entry["format"] == "ply"), None)
    rows = []
    for entry in encodings:
        share = f"1/{whole['bytes'] / max(entry['bytes'], 1):.1f}" if whole else ""
        psnr = "" if entry["psnr"] is None else f"{entry['psnr']:.2f} dB"
        if entry is not whole and whole and None not in (entry["psnr"], whole["psnr"]):
            psnr += f" ({entry['psnr'] - whole['psnr']:+.2f})"
        each = f"{entry['bytes'] / max(entry['num_gaussians'], 1):.1f}"
        rows.append((entry["format"], f"{entry['bytes'] / 1e6:.2f}", each, share, psnr))
    return rows


def viewer_script() -> str:
    """Return the script of the page that shows the splat."""
    return asset("html", "viewer.js")


def is_framed(page: str | None) -> bool:
    """Tell whether the report shows that page in a frame: where it is not too large, and has this version's script.

    A page that another version or another program has written is opened by itself: the report lets no script run but
    those of this package.
    """
    return page is not None and len(page) <= _LARGEST and f"<script>{viewer_script()}</script></body>" in page


def viewer_section(page: str | None) -> str:
    """Show the page that shows the splat, in a frame of its own; nothing where there is none."""
    if page is None:
        return ""
    about = "Drag, pinch or use the arrows; it starts at a training camera. The same page lies beside this report as "
    about += '<a href="viewer.html">viewer.html</a>.'
    if not is_framed(page):
        return f'<h2>The splat</h2><p>{len(page) / 1e6:.0f} MB, in <a href="viewer.html">viewer.html</a>.</p>'
    return (
        f"<h2>The splat</h2><p>{about}</p>"
        '<iframe class="viewer" title="the splat" loading="lazy" allow="fullscreen" '
        f'srcdoc="{escape(page)}"></iframe>'
    )


def sizes_section(table: Sequence[Sequence[str]]) -> str:
    """Tell what the splat weighs in every format, and what it then is worth, from heads and rows."""
    if not table:
        return ""
    heads, *rows = table
    head = "".join(f"<th{'' if k == 0 else ' class=n'}>{name}</th>" for k, name in enumerate(heads))
    body = "".join(
        "<tr>"
        + "".join(f"<td{'' if k == 0 else ' class=n'}>{escape(cell)}</td>" for k, cell in enumerate(row))
        + "</tr>"
        for row in rows
    )
    return (
        "<h2>Files</h2><p>The splat in every format that <code>pop export --to FORMAT</code> writes, and the PSNR of "
        "some held-out views when it is read back from there.</p>"
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    )
