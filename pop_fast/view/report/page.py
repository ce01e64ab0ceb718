"""The report as one self-contained HTML page: no network, images embedded, light and dark, readable on a phone."""

from __future__ import annotations

import base64
import shlex
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, Final
from urllib.parse import quote

import numpy as np

from pop_fast.io import images
from pop_fast.view.document import Chart, Series, asset, document, draw, draw_histogram
from pop_fast.view.report.model import Finding, Histogram, ReportData, ReportView, Tile

# (curve, legend, colour, dots)
_OF_TRAINING: Final = ("psnr_train", "training view, running mean", "var(--c1)", False)
_OF_HELD_OUT: Final = ("psnr_val", "held-out views", "var(--c2)", True)
_TRAVERSED: Final = ("n_traversed", "traversed", "var(--c2)", False)
_BLENDED: Final = ("n_blended", "blended", "var(--c1)", False)
# (title, curves, log axis, axis from zero, unit)
_CHARTS: Final = (
    ("Gaussians", (("num_gaussians", "N", "var(--c1)", False),), False, True, ""),
    ("PSNR, dB", (_OF_TRAINING, _OF_HELD_OUT), False, False, " dB"),
    ("Loss", (("loss", "running mean", "var(--c1)", False),), True, False, ""),
    ("Gaussians per pixel", (_TRAVERSED, _BLENDED), False, True, ""),
)


def page(data: ReportData) -> str:
    body = "".join(
        [
            f"<header><h1>{escape(data.title)}</h1><p>{escape(data.subtitle)}</p></header>",
            _tiles(data.headline),
            verdict_section(data.verdict, data.checked),
            views_section(data.views, data.n_held_out),
            viewer_section(data.viewer),
            orbit_section(data.orbit),
            _curves(data),
            _opacities(data.histograms),
            _dominance(data),
            sizes_section(data.files),
            open_section(data.links),
            command_section(data.commands),
            _tables(data),
            "<footer>Written by <code>pop</code> from the files next to it; nothing comes from the network.</footer>",
        ]
    )
    framed = viewer_script() if is_framed(data.viewer) else ""
    return document(data.title, asset("report", "page.css"), body, asset("report", "page.js"), framed)


def _tiles(headline: Sequence[Tile]) -> str:
    tiles = [
        f'<div class="tile"><small>{escape(tile.label)}</small><b>{escape(tile.value)} <i>{escape(tile.unit)}</i></b>'
        f"<small>{escape(tile.note)}</small></div>"
        for tile in headline
    ]
    return f'<section class="tiles">{"".join(tiles)}</section>'


def _curves(data: ReportData) -> str:
    charts = []
    for title, lines, log, zero, unit in _CHARTS:
        series = [
            Series(legend, *data.curves[name], color, dots)
            for name, legend, color, dots in lines
            if name in data.curves and len(data.curves[name][0])
        ]
        if series:
            charts.append(draw(Chart(title, series, data.max_steps, data.windows, data.resets, log, zero, unit)))
    if not charts:
        return ""
    key = "".join(
        f'<span><i style="background:{w.color}"></i>{escape(w.name)} {w.start:g}–{w.stop:g}</span>'
        for w in data.windows
    )
    if data.resets:
        key += f"<span>dashed: opacity reset at {', '.join(f'{step:g}' for step in data.resets)}</span>"
    return (
        "<h2>Training</h2>"
        "<p>Values over the iterations. The coloured bars above each plot are the phases of the schedule.</p>"
        f'<div class="legend key">{key}</div><div class="charts">{"".join(charts)}</div>'
    )


def _opacities(histograms: Sequence[Histogram]) -> str:
    if not histograms:
        return ""
    # all Gaussians start at one opacity: that single bar would flatten the other charts, so it may leave the axis
    tallest = [float(h.shares.max(initial=0.0)) for h in histograms]
    top = max(tallest[1:] or tallest) * 1.12
    drawn = []
    for h in histograms:
        low, high = (100.0 * h.share_between(*span) for span in ((0, 0.1), (0.9, 1.0)))
        notes = (f"{low:.1f} % under 0.1", f"{high:.1f} % over 0.9")
        drawn.append(draw_histogram(h.title, h.shares.tolist(), top, "var(--c1)", notes))
    return (
        "<h2>Opacity</h2>"
        "<p>Share of the Gaussians by opacity. Polarised means: near 1, or near 0, where <code>pop export "
        "--min-opacity</code> or <code>--final-prune</code> leaves them out of a file.</p>"
        f'<div class="charts three">{"".join(drawn)}</div>'
    )


def _dominance(data: ReportData) -> str:
    if data.dominant is None:
        return ""
    name, ids, render = data.dominant
    n_owners = len(np.unique(ids[ids >= 0]))
    share = 100.0 * float((ids >= 0).mean())
    ids_uri = images.data_uri(images.fit(images.id_colors(ids), nearest=True), lossless=True)
    return (
        "<h2>Who owns each pixel</h2>"
        "<p>The dominant Gaussian of a pixel is the one with the largest blending weight there. "
        "One colour is one Gaussian; black is a pixel that no Gaussian reaches.</p>"
        '<div class="view"><div class="pair">'
        f'<figure><img class="ids" alt="dominant Gaussians of {escape(name)}" src="{ids_uri}">'
        f'<figcaption class="caption">{n_owners:,} Gaussians own {share:.1f} % of the pixels</figcaption></figure>'
        f'<figure><img alt="render of {escape(name)}" src="{images.data_uri(images.fit(render))}">'
        f'<figcaption class="caption">{escape(name)}</figcaption></figure></div></div>'
    )


def _tables(data: ReportData) -> str:
    parts = []
    if data.changes:
        columns = list(dict.fromkeys(key for change in data.changes for key in change))
        parts.append(_table(f"Densification steps ({len(data.changes)})", columns, data.changes))
    if data.config:
        rows = [{"setting": key, "value": value} for key, value in data.config.items()]
        parts.append(_table("Settings", ["setting", "value"], rows))
    return f"<h2>Record</h2>{''.join(parts)}" if parts else ""


def _table(title: str, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> str:
    numeric = {c: all(isinstance(r.get(c, 0), int | float) for r in rows) for c in columns}
    mark = {c: ' class="n"' if numeric[c] else "" for c in columns}
    head = "".join(f"<th{mark[c]}>{escape(c.replace('_', ' '))}</th>" for c in columns)
    lines = "".join(
        "<tr>" + "".join(f"<td{mark[c]}>{escape(_cell(r.get(c)))}</td>" for c in columns) + "</tr>" for r in rows
    )
    return (
        f'<details><summary>{escape(title)}</summary><div class="scroll"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{lines}</tbody></table></div></details>"
    )


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return ", ".join(_cell(v) for v in value)
    return str(value)


# a video that is larger than this is linked, not put into the report
_LARGEST_FILM: Final = 8 * 2**20
_SIGNS: Final = {"good": ("✓", "as it should be"), "look": ("!", "worth a look"), "bad": ("✗", "spoils the result")}
_UNCHECKED: Final = (
    "<p>Overfitting, exposure, floaters, depth and the orbit were not checked; "
    "<code>pop report RESULT --check</code> does it if the capture is there.</p>"
)


def verdict_section(findings: Sequence[Finding], checked: bool) -> str:
    if not findings and checked:
        return ""
    rows = "".join(
        f'<li class="{finding.kind}">{_sign(*_SIGNS[finding.kind])}'
        f"<b>{escape(finding.about)}</b><span>{escape(finding.text)}{_to_type(finding)}</span></li>"
        for finding in findings
    )
    return f'<h2>Verdict</h2>{"" if checked else _UNCHECKED}<ul class="verdict">{rows}</ul>'


def _sign(mark: str, about: str) -> str:
    return f'<i role="img" aria-label="{about}" title="{about}">{mark}</i>'


def _to_type(finding: Finding) -> str:
    return f" <code>{escape(shlex.join(['pop', *finding.next]))}</code>" if finding.next else ""


def orbit_section(orbit: tuple[str, bytes] | None) -> str:
    if orbit is None:
        return ""
    path, data = orbit
    about = "An orbit around what the cameras look at, as far round as photographs were taken. If they look at no one "
    about += "thing, as on a walk or in a room, it is a path through them."
    if len(data) > _LARGEST_FILM:
        return f"<h2>The orbit</h2><p>{about} {_link(path, path)}, {len(data) / 1e6:.0f} MB.</p>"
    uri = f"data:video/webm;base64,{base64.b64encode(data).decode('ascii')}"
    return (
        f"<h2>The orbit</h2><p>{about}</p>"
        f'<video class="orbit" controls loop muted playsinline aria-label="orbit" src="{uri}"></video>'
    )


def open_section(links: Sequence[tuple[str, str, int]]) -> str:
    if not links:
        return ""
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td>{_link(path, path)}</td><td class=n>{_size(size)}</td></tr>"
        for name, path, size in links
    )
    return f'<h2>Next to this page</h2><div class="scroll"><table><tbody>{rows}</tbody></table></div>'


def command_section(commands: Sequence[tuple[str, str]]) -> str:
    if not commands:
        return ""
    lines = "".join(
        f'<pre class="command">{escape(line)}</pre><p class="caption">in {escape(folder)}</p>'
        for line, folder in commands
    )
    if len(commands) == 1:
        return f"<h2>The command</h2><p>This command made the result.</p>{lines}"
    about = "These commands made the result. The first began the run, the others resumed it."
    return f"<h2>The commands</h2><p>{about}</p>{lines}"


def _link(path: str, words: str) -> str:
    return f'<a href="{escape(quote(path, errors="surrogateescape"))}">{escape(words)}</a>'


def _size(size: int) -> str:
    return f"{size / 1e6:.2f} MB" if size >= 1e5 else f"{size / 1e3:.1f} kB"


# a page that is larger than this is linked, not put into the report
_LARGEST: Final = 16 * 2**20


def viewer_script() -> str:
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
    about = "Drag, pinch, or click it and use the wheel or the arrows; it starts at a training camera. "
    about += 'The same page is next to this report as <a href="viewer.html">viewer.html</a>.'
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
        "<h2>Files</h2><p>The splat in every format that <code>pop export --to FORMAT</code> writes, and where views "
        "are held out its PSNR after reading the file back.</p>"
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    )


def views_section(views: Sequence[ReportView], n_held_out: int | None) -> str:
    """Show held-out views, the worst first, of all that were measured."""
    if not views:
        return ""
    errors = [images.error_magnitude(view.render, view.photo) for view in views]
    top = images.error_scale(errors)
    near, far = images.depth_range([view.depth for view in views if view.depth is not None])
    rows = [_view(view, error, top, near, far) for view, error in zip(views, errors, strict=True)]
    some = f" Pictures of {len(views)} of {n_held_out}." if n_held_out is not None and n_held_out > len(views) else ""
    legend = _bar("error", images.colorbar_css(), "0", f"{255 * top:.0f} of 255 and more")
    if any(view.depth is not None for view in views):
        most = f"{far:.3g} units of the capture, logarithmic"
        legend += _bar("depth", images.colorbar_css(images.DEPTH_COLORS), f"{near:.3g}", most)
    return (
        "<h2>Held-out views, the worst first</h2><p>Photographs that training never saw: drag the line between "
        "photograph and render. Error is the mean over the channels of |render − photo|; depth is the mean of what a "
        f"pixel blends, grey where nothing is; one scale for all views.{some}</p>"
        f'<div class="bars">{legend}</div><div class="views">{"".join(rows)}</div>'
    )


def _view(view: ReportView, error: np.ndarray, top: float, near: float, far: float) -> str:
    name = escape(view.name)
    numbers = [] if view.psnr is None else [f"PSNR {view.psnr:.2f} dB"]
    numbers += [] if view.ssim is None else [f"SSIM {view.ssim:.4f}"]
    head = f"<b>{name}</b>" + "".join(f'<span class="num">{text}</span>' for text in numbers)
    height, width = view.photo.shape[:2]
    beside = [_figure("error", name, images.error_picture(error, top))]
    if view.depth is not None:
        beside.append(_figure("depth", name, images.depth_picture(view.depth, near, far)))
    slider = (
        f'<figure class="slider" style="aspect-ratio:{width}/{height}">'
        f'<img alt="photo of {name}" src="{images.data_uri(images.fit(view.photo))}">'
        f'<img class="over" alt="render of {name}" src="{images.data_uri(images.fit(view.render))}">'
        '<span class="left">photograph</span><span class="right">render</span><i></i>'
        f'<input type="range" min="0" max="100" step="0.5" value="50" aria-label="photograph against render, {name}">'
        "</figure>"
    )
    kind = "tall" if height > width else "wide"
    return f'<div class="view"><p>{head}</p><div class="looks {kind}">{slider}{"".join(beside)}</div></div>'


def _figure(what: str, name: str, picture: np.ndarray) -> str:
    uri = images.data_uri(images.fit(picture))
    return f'<figure><img alt="{what} of {name}" src="{uri}"><figcaption class="caption">{what}</figcaption></figure>'


def _bar(what: str, colors: str, low: str, high: str) -> str:
    return f'<div class="bar"><span>{what}</span>{low}<i style="background:{colors}"></i>{high}</div>'
