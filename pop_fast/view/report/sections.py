"""The report's sections: the verdict, the orbit, the commands; the files and their sizes; the held-out views."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, Final
from urllib.parse import quote

import numpy as np

from pop_fast.errors import PopError
from pop_fast.io import pictures
from pop_fast.train.results import shell_line
from pop_fast.view.document import asset
from pop_fast.view.report.model import Finding, ReportView

# a video that is larger than this is linked, not put into the report
_LARGEST_FILM: Final = 8 * 2**20
_SIGNS: Final = {"good": ("✓", "as it should be"), "look": ("!", "worth a look"), "bad": ("✗", "spoils the result")}
_UNCHECKED: Final = (
    "<p>Overfitting, exposure, floaters, depth and the orbit were not looked at; "
    "<code>pop report RESULT --check</code> does it, where the capture is.</p>"
)


def verdict_section(findings: Sequence[Finding], checked: bool) -> str:
    """Say how the run went."""
    if not findings and checked:
        return ""
    rows = "".join(
        f'<li class="{finding.kind}"><i title="{_SIGNS[finding.kind][1]}">{_SIGNS[finding.kind][0]}</i>'
        f"<b>{escape(finding.about)}</b><span>{escape(finding.text)}{_to_type(finding)}</span></li>"
        for finding in findings
    )
    return f'<h2>Verdict</h2>{"" if checked else _UNCHECKED}<ul class="verdict">{rows}</ul>'


def _to_type(finding: Finding) -> str:
    return f" <code>{escape(shell_line(['pop', *finding.next]))}</code>" if finding.next else ""


def orbit_section(orbit: tuple[str, bytes] | None) -> str:
    """Show the orbit."""
    if orbit is None:
        return ""
    path, data = orbit
    about = "A turn about what the cameras look at, as far round as photographs were taken; where they look at no one "
    about += "thing, as on a walk or in a room, a path through them."
    if len(data) > _LARGEST_FILM:
        return f"<h2>The orbit</h2><p>{about} {_link(path, path)}, {len(data) / 1e6:.0f} MB.</p>"
    uri = f"data:video/webm;base64,{base64.b64encode(data).decode('ascii')}"
    return (
        f"<h2>The orbit</h2><p>{about}</p>"
        f'<video class="orbit" controls loop muted playsinline aria-label="orbit" src="{uri}"></video>'
    )


def open_section(links: Sequence[tuple[str, str, int]]) -> str:
    """Link the files beside the report."""
    if not links:
        return ""
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td>{_link(path, path)}</td><td class=n>{_size(size)}</td></tr>"
        for name, path, size in links
    )
    return f'<h2>Beside this page</h2><div class="scroll"><table><tbody>{rows}</tbody></table></div>'


def command_section(commands: Sequence[tuple[str, str]]) -> str:
    """Give what was typed."""
    if not commands:
        return ""
    lines = "".join(
        f'<pre class="command">{escape(line)}</pre><p class="caption">in {escape(folder)}</p>'
        for line, folder in commands
    )
    later = " The first began the run, the others resumed it." if len(commands) > 1 else ""
    return f"<h2>The command</h2><p>What made this result.{later}</p>{lines}"


def _link(path: str, words: str) -> str:
    return f'<a href="{escape(quote(path, errors="surrogateescape"))}">{escape(words)}</a>'


def _size(size: int) -> str:
    return f"{size / 1e6:.2f} MB" if size >= 1e5 else f"{size / 1e3:.1f} kB"


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
        encodings: entries of the statistics, as `pop_fast.train.evaluate.Encoding` makes them.

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


DEPTH_COLORS: Final = "viridis_r"
_NOTHING: Final = (112, 112, 118)


def views_section(views: Sequence[ReportView], n_held_out: int | None) -> str:
    """Show held-out views.

    Args:
        views: the worst first.
        n_held_out: how many were measured, more than have pictures perhaps.
    """
    if not views:
        return ""
    errors = [pictures.error_magnitude(view.render, view.photo) for view in views]
    top = pictures.error_scale(errors)
    near, far = depth_range([view.depth for view in views if view.depth is not None])
    rows = [_view(view, error, top, near, far) for view, error in zip(views, errors, strict=True)]
    some = f" Pictures of {len(views)} of {n_held_out}." if n_held_out is not None and n_held_out > len(views) else ""
    legend = _bar("error", pictures.colorbar_css(), "0", f"{255 * top:.0f} of 255 and more")
    if any(view.depth is not None for view in views):
        legend += _bar(
            "depth", pictures.colorbar_css(DEPTH_COLORS), f"{near:.3g}", f"{far:.3g} units of the capture, logarithmic"
        )
    return (
        "<h2>Held-out views, the worst first</h2><p>Photographs that training never saw: drag the line between "
        "photograph and render. Error is the mean over the channels of |render − photo|; depth is the mean of what a "
        f"pixel blends, grey where nothing is; one scale for all views.{some}</p>"
        f'<div class="bars">{legend}</div><div class="views">{"".join(rows)}</div>'
    )


def depth_range(depths: Sequence[np.ndarray]) -> tuple[float, float]:
    """Choose one range for all depth maps: their joint 1st to 99th percentile, without NaN."""
    known = [depth[np.isfinite(depth)][:: max(1, depth.size // 50_000)] for depth in depths]
    joined = np.concatenate(known) if known else np.zeros(0)
    if not len(joined):
        return 0.1, 1.0
    near, far = (max(float(np.quantile(joined, q)), 1e-12) for q in (0.01, 0.99))
    return near, max(far, near * (1.0 + 1e-6))


def depth_picture(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Colour a depth map by its logarithm, near in yellow and far in violet, grey where it is not finite.

    A garden has its background many times as far away as its table: evenly spaced colours would leave the table one.

    Args:
        depth: over 0, or NaN. [H, W]
        near: yellow, over 0.
        far: violet, over `near`.

    Returns:
        uint8 [H, W, 3]
    """
    known = np.isfinite(depth)
    level = np.log(np.clip(np.where(known, depth, near), near, far) / near) / np.log(far / near)
    picture = pictures.colormap_table(DEPTH_COLORS)[np.round(255.0 * level).astype(np.uint8)]
    picture[~known] = _NOTHING
    return picture


def _view(view: ReportView, error: np.ndarray, top: float, near: float, far: float) -> str:
    name = escape(view.name)
    numbers = [] if view.psnr is None else [f"PSNR {view.psnr:.2f} dB"]
    numbers += [] if view.ssim is None else [f"SSIM {view.ssim:.4f}"]
    head = f"<b>{name}</b>" + "".join(f'<span class="num">{text}</span>' for text in numbers)
    height, width = view.photo.shape[:2]
    beside = [_figure("error", name, pictures.error_picture(error, top))]
    if view.depth is not None:
        beside.append(_figure("depth", name, depth_picture(view.depth, near, far)))
    slider = (
        f'<figure class="slider" style="aspect-ratio:{width}/{height}">'
        f'<img alt="photo of {name}" src="{pictures.data_uri(pictures.fit(view.photo))}">'
        f'<img class="over" alt="render of {name}" src="{pictures.data_uri(pictures.fit(view.render))}">'
        '<span class="left">photograph</span><span class="right">render</span><i></i>'
        f'<input type="range" min="0" max="100" step="0.5" value="50" aria-label="photograph against render, {name}">'
        "</figure>"
    )
    kind = "tall" if height > width else "wide"
    return f'<div class="view"><p>{head}</p><div class="looks {kind}">{slider}{"".join(beside)}</div></div>'


def _figure(what: str, name: str, picture: np.ndarray) -> str:
    uri = pictures.data_uri(pictures.fit(picture))
    return (
        f'<figure><img loading="lazy" alt="{what} of {name}" src="{uri}">'
        f'<figcaption class="caption">{what}</figcaption></figure>'
    )


def _bar(what: str, colors: str, low: str, high: str) -> str:
    return f'<div class="bar"><span>{what}</span>{low}<i style="background:{colors}"></i>{high}</div>'
