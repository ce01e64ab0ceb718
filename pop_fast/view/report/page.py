"""The report as one self-contained HTML page: no network, images embedded, light and dark, readable on a phone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_fast.io import pictures
from pop_fast.io.atomic import write_atomically
from pop_fast.view.document import asset, document
from pop_fast.view.report.curves import Chart, Series, draw, draw_histogram
from pop_fast.view.report.model import Histogram, ReportData, Tile
from pop_fast.view.report.sections import (
    command_section,
    is_framed,
    open_section,
    orbit_section,
    sizes_section,
    verdict_section,
    viewer_script,
    viewer_section,
    views_section,
)
from pop_fast.view.report.source import read_result

# (title, ((curve, legend, colour, dots), ...), log axis, axis from zero, unit)
_CHARTS: Final = (
    ("Gaussians", (("num_gaussians", "N", "var(--c1)", False),), False, True, ""),
    (
        "PSNR, dB",
        (
            ("psnr_train", "training view, running mean", "var(--c1)", False),
            ("psnr_val", "held-out views", "var(--c2)", True),
        ),
        False,
        False,
        " dB",
    ),
    ("Loss", (("loss", "running mean", "var(--c1)", False),), True, False, ""),
    (
        "Gaussians per pixel",
        (
            ("n_traversed", "traversed", "var(--c2)", False),
            ("n_blended", "blended", "var(--c1)", False),
        ),
        False,
        True,
        "",
    ),
)


def page(data: ReportData) -> str:
    """Lay out the whole page."""
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
            "<footer>Written by <code>pop</code> from the files beside it; nothing comes from the network.</footer>",
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
        "<p>Against the iteration. The coloured bars above each plot are the stretches of the schedule.</p>"
        f'<div class="legend key">{key}</div><div class="charts">{"".join(charts)}</div>'
    )


def _opacities(histograms: Sequence[Histogram]) -> str:
    if not histograms:
        return ""
    # all Gaussians start at one opacity: that single bar would flatten the other charts, so it may leave the axis
    tallest = [float(h.shares.max(initial=0.0)) for h in histograms]
    top = max(tallest[1:] or tallest) * 1.12
    drawn = [
        draw_histogram(
            h.title,
            h.shares.tolist(),
            top,
            "var(--c1)",
            (f"{100 * h.share_between(0, 0.1):.1f} % under 0.1", f"{100 * h.share_between(0.9, 1.0):.1f} % over 0.9"),
        )
        for h in histograms
    ]
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
    ids_uri = pictures.data_uri(pictures.fit(pictures.id_colors(ids), nearest=True), lossless=True)
    return (
        "<h2>Who owns each pixel</h2>"
        "<p>The dominant Gaussian of a pixel is the one with the largest blending weight there. "
        "One colour is one Gaussian; black is a pixel that no Gaussian reaches.</p>"
        '<div class="view"><div class="pair">'
        f'<figure><img class="ids" alt="dominant Gaussians of {escape(name)}" src="{ids_uri}">'
        f'<figcaption class="caption">{n_owners:,} Gaussians own {share:.1f} % of the pixels</figcaption></figure>'
        f'<figure><img alt="render of {escape(name)}" src="{pictures.data_uri(pictures.fit(render))}">'
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


def write_report(result_dir: str | Path) -> Path:
    """Write report.html into a result folder, from the files in it alone.

    Returns:
        The page's path.

    Raises:
        PopError: the folder is not a result of `pop train`, or one of its files cannot be read.
    """
    folder = Path(result_dir)
    # a name that is no text is shown with escapes
    html = page(read_result(folder)).encode("utf-8", "backslashreplace")
    target = folder / "report.html"
    write_atomically(target, lambda file: file.write(html))
    return target
