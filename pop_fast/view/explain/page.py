"""The explanation as one self-contained HTML page: the picture, the pixel, the splats' ellipses, the walk, the maps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import numpy as np

from pop_fast.io.images import data_uri, fit, id_colors
from pop_fast.view.document import asset, document, element
from pop_fast.view.explain.pixel import PixelExplanation, Row, weighty
from pop_fast.view.explain.scene import Map, crop
from pop_ref.constants import PROFILES

Box = tuple[int, int, int, int]


def stage(e: PixelExplanation, rows: Sequence[Row], picture: np.ndarray, box: Box, inner: Box | None) -> str:
    """Lay ellipses and the pixel's mark over a picture of the part `box` of the view: left, top, width and height, px.

    The heaviest splats come first; `inner` is a part to outline, or None for a close-up.
    """
    floor = PROFILES[e.profile].alpha_floor
    # the heaviest is drawn last, on top, where the pointer finds it
    drawing = "".join(_splat(row, floor) for row in reversed(rows))
    if inner is not None:
        left, top, width, height = inner
        drawing += element("rect", kind="frame", x=left, y=top, width=width, height=height)
    drawing += _mark(e.x, e.y, box, inner is None)
    view_box = " ".join(map(str, box))
    svg = element("svg", drawing, viewBox=view_box, preserveAspectRatio="none", role="img", aria_label="splats")
    image = f'<img alt="render" src="{data_uri(picture, lossless=True)}">'
    return f'<div class="stage{" zoom" if inner is None else ""}">{image}{svg}</div>'


def ellipse_of(conic: Sequence[float]) -> tuple[float, float, float]:
    """Give a conic's standard deviations along its axes, px, and the angle of the first axis, degrees."""
    A, B, C = conic
    values, vectors = np.linalg.eigh(np.array([[A, B], [B, C]]))
    angle = math.degrees(math.atan2(vectors[1, 0], vectors[0, 0]))
    return 1.0 / math.sqrt(values[0]), 1.0 / math.sqrt(values[1]), angle


def _splat(row: Row, floor: float) -> str:
    rx, ry, angle = ellipse_of(row.conic)
    r, g, b = id_colors(np.array([[row.id]]))[0, 0].tolist()
    u, v = row.mean2d
    place = {"cx": f"{u:.3f}", "cy": f"{v:.3f}", "transform": f"rotate({angle:.2f} {u:.3f} {v:.3f})"}
    title = f"#{row.rank}, Gaussian {row.id}: weight {row.weight:.4f}, alpha {row.alpha:.4f}, opacity {row.opacity:.4f}"
    color = f"rgb({r},{g},{b})"
    body = element("ellipse", "", title, rx=f"{rx:.3f}", ry=f"{ry:.3f}", fill=color, stroke=color, **place)
    reach = math.sqrt(max(2.0 * math.log(max(row.blend_opacity / floor, 1.0)), 0.0))
    body += element("ellipse", kind="edge", rx=f"{reach * rx:.3f}", ry=f"{reach * ry:.3f}", **place)
    return f'<g class="splat" data-id="{row.id}">{body}</g>'


def _mark(x: int, y: int, box: Box, close: bool) -> str:
    if close:
        shape = f"M{x} {y}h1v1h-1z"
    else:
        reach, gap = 0.035 * max(box[2:]), 0.012 * max(box[2:])
        u, v = x + 0.5, y + 0.5
        arms = ((1, 0), (-1, 0), (0, 1), (0, -1))
        shape = "".join(
            f"M{u + gap * i:.2f} {v + gap * j:.2f}L{u + reach * i:.2f} {v + reach * j:.2f}" for i, j in arms
        )
    return element("path", kind="halo", d=shape) + element("path", kind="aim", d=shape)


def light_bar(e: PixelExplanation) -> str:
    """Draw the weights front to back as one bar, each in its splat's colour, the background's share hatched."""
    hatch = (
        '<defs><pattern id="hatch" width="6" height="6" patternUnits="userSpaceOnUse" patternTransform="rotate(45)">'
        f'<rect width="6" height="6" fill="{css_color(e.background)}" stroke="none"/>'
        '<rect width="2" height="6" fill="#8888" stroke="none"/></pattern></defs>'
    )
    pieces, left = [hatch], 0.0
    for row in e.blended:
        title = f"#{row.rank}, Gaussian {row.id}: weight {row.weight:.4f}"
        # the dominant one stands out in height
        place = {"x": f"{1000 * left:.3f}", "width": f"{1000 * row.weight:.3f}"}
        size = {"y": 0, "height": 74} if row.dominant else {"y": 12, "height": 62}
        rect = element("rect", "", title, fill=css_color(row.color), **place, **size)
        pieces.append(f'<g data-id="{row.id}">{rect}</g>')
        left += row.weight
    title = f"background: {e.T_final:.4f}"
    share = {"x": f"{1000 * left:.3f}", "width": f"{1000 * e.T_final:.3f}"}
    pieces.append(element("rect", "", title, fill="url(#hatch)", y=12, height=62, **share))
    body = "".join(pieces)
    shape = {"viewBox": "0 0 1000 74", "preserveAspectRatio": "none"}
    return element("svg", body, kind="light", role="img", aria_label="weights of the splats, front to back", **shape)


def css_color(color: Sequence[float]) -> str:
    return "#" + "".join(f"{round(255 * min(max(c, 0.0), 1.0)):02x}" for c in color)


_DRAWN = 14
_ZOOM = (21, 81)  # px, the smallest and the largest close-up


def page(e: PixelExplanation, maps: Sequence[Map], differences: Sequence[str] = ()) -> str:
    """Lay out the page, with maps of the same view, and lines that tell where two renderers differ, if asked for."""
    pictures = {entry.name: entry.picture for entry in maps}
    drawn = sorted(e.blended, key=lambda row: -row.weight)[:_DRAWN]
    about = f"{e.width} x {e.height} px, profile {e.profile}, {e.n_gaussians:,} Gaussians; loss {e.objective}"
    about += f" + {e.lambda_pop:g} L_POP" if e.lambda_pop else ""
    body = "".join(
        [
            f"<header><h1>Why pixel ({e.x}, {e.y}) of {escape(e.view)} looks like that</h1>",
            f"<p>{escape(about)}</p></header>",
            _tiles(e),
            _stages(e, drawn, pictures),
            _light(e),
            _walk(e),
            f"<h2>Where two renderers part</h2><pre>{escape(chr(10).join(differences))}</pre>" if differences else "",
            f'<h2>The view as maps</h2><div class="maps">{"".join(map(_map, maps))}</div>',
            "<footer>Written by <code>pop explain</code>; the numbers are the oracle's, in float64.</footer>",
        ]
    )
    style = asset("report", "page.css") + asset("explain", "page.css")
    return document(f"{e.view} ({e.x}, {e.y})", style, body, asset("explain", "page.js"))


def _tiles(e: PixelExplanation) -> str:
    stop = e.stopped_by
    dominant = next((row for row in e.rows if row.dominant), None)
    error = float(np.mean([abs(a - b) for a, b in zip(e.color, e.photo, strict=True)]))
    cells = [
        ("Rendered", _swatch(e.color), " ".join(f"{c:.3f}" for c in e.color)),
        ("Photograph", _swatch(e.photo), f"{' '.join(f'{c:.3f}' for c in e.photo)}; error {error:.3f}"),
        (
            "Blended",
            f"{len(e.blended)} <i>of {e.n_traversed} visited</i>",
            f"{len(e.rows)} in the tile; " + (f"#{stop.rank} ended the walk (D7)" if stop else "the list ran out"),
        ),
        (
            "Dominant",
            f"{dominant.id} <i>{100.0 * dominant.weight:.0f} %</i>" if dominant else "none",
            f"opacity {dominant.opacity:.3f}; dominates {dominant.pixels_dominated:,} pixels" if dominant else "",
        ),
    ]
    tiles = "".join(
        f'<div class="tile"><small>{name}</small><b>{value}</b><small>{note}</small></div>'
        for name, value, note in cells
    )
    return f'<section class="tiles">{tiles}</section>'


def _swatch(color: Sequence[float]) -> str:
    css = css_color(color)
    return f'<span class="swatch" style="background:{css}"></span>{css}'


def _stages(e: PixelExplanation, drawn: Sequence[Row], pictures: dict[str, np.ndarray]) -> str:
    whole = fit(pictures["render"], max_side=960)
    side = _close_up(drawn)
    near, left, top = crop(pictures["render"], e.x, e.y, side)
    box = (left, top, near.shape[1], near.shape[0])
    kind = "tall" if e.height > e.width else "wide"
    names = {"photo": "photograph", "dominant_ids": "dominant Gaussian", "pop_pull": "where POP pulls"}
    small = "".join(
        f'<figure><img alt="{name}" src="{data_uri(crop(pictures[key], e.x, e.y, side)[0], lossless=True)}">'
        f'<div class="caption">{name}</div></figure>'
        for key, name in names.items()
        if key in pictures
    )
    return (
        f'<section class="duo {kind}"><figure>{stage(e, drawn, whole, (0, 0, e.width, e.height), box)}'
        f'<div class="caption">The render. The cross marks the pixel, the dashed square what is enlarged; ellipses are '
        f"the {len(drawn)} heaviest splats at one standard deviation.</div></figure><div>"
        f'<figure>{stage(e, drawn, near, box, None)}<div class="caption">{box[2]} x {box[3]} px around it. Point at an '
        "ellipse, a piece of the bar or a line of the table, or go to a line by Tab: the splat lights up everywhere, "
        f'dashed where its alpha falls to the floor.</div></figure><div class="small3">{small}</div></div></section>'
    )


def _close_up(drawn: Sequence[Row]) -> int:
    """Choose a side that shows whole ellipses of the splats that carry most of the pixel."""
    heavy = [row for row in drawn if row.weight >= 0.02] or list(drawn)
    reach = max((row.distance + max(ellipse_of(row.conic)[:2]) for row in heavy), default=0.0)
    return min(max(2 * round(1.15 * reach) + 1, _ZOOM[0]), _ZOOM[1])


def _light(e: PixelExplanation) -> str:
    return (
        "<h2>Where the light comes from</h2><p>Front to back: each splat takes its weight T alpha of the pixel, "
        "in its own colour; the hatched part is the background, with the remaining light.</p>"
        f'<div class="lightbox">{light_bar(e)}</div><div class="ticks"><span>front, T = 1</span>'
        f"<span>T_final = {e.T_final:.5f}</span></div>"
    )


_POP_COLUMN = ("POP", "derivative of the weighted POP term; up: it raises the opacity")
_COLUMNS = (
    ("#", "place in the tile's list"),
    ("id", "the Gaussian"),
    ("depth", "camera z"),
    ("dist", "px from the pixel's centre to the splat's"),
    ("G", "falloff, exp(-sigma)"),
    ("o", "opacity"),
    ("o G", "alpha before the ceiling"),
    ("alpha", "clamped (D6)"),
    ("T", "transmittance in front"),
    ("weight", "T alpha"),
    ("colour", "of the splat from here"),
    ("sum", "the pixel so far"),
    ("dL/dalpha", "photometric, here"),
    ("dL/do", "photometric, through this pixel"),
    ("dL/do view", "photometric, through the whole view"),
    _POP_COLUMN,
    ("net", "where the whole objective, over the whole view, moves the opacity"),
)


def _walk(e: PixelExplanation) -> str:
    chosen = weighty(e, 30)
    has_pop = e.lambda_pop > 0.0
    columns = [column for column in _COLUMNS if has_pop or column != _POP_COLUMN]
    head = "".join(f'<th title="{escape(about)}">{name}</th>' for name, about in columns)
    rows = "".join(_row(row, row.rank in chosen, has_pop) for row in e.rows)
    pop = ""
    if e.lambda_pop:
        pop = (
            f" {e.n_important:,} of {e.n_gaussians:,} Gaussians dominate a pixel of this view: POP pulls those up and "
            "pushes the others down."
        )
    note = f" {escape(e.pop_note[0].upper() + e.pop_note[1:])}." if e.pop_note else ""
    return (
        f"<h2>The walk</h2><p>Descent moves against a derivative: a negative dL/do raises the opacity.{pop}{note}</p>"
        f'<label class="switch"><input type="checkbox" id="all"> all {len(e.rows)} entries, the skipped too</label>'
        f'<div class="scroll"><table class="walk"><thead><tr>{head}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )


def _row(row: Row, chosen: bool, has_pop: bool) -> str:
    blended = row.status == "blended"
    kinds = [row.status, *["dominant"] * row.dominant, *["faint"] * (blended and not chosen)]
    pill = '<span class="pill">D8</span>' if row.dominant else ""
    clamp = '<span class="pill">D6</span>' if row.clamped else ""
    front = [
        f"{row.rank}",
        f"{pill}{row.id}",
        f"{row.depth:.3f}" if row.depth < 100.0 else f"{row.depth:.0f}",
        f"{row.distance:.1f}",
        f"{row.falloff:.4f}",
        f"{row.opacity:.4f}",
        f"{row.alpha_raw:.4f}",
        f"{clamp}{row.alpha:.4f}",
    ]
    body = "".join(f"<td>{cell}</td>" for cell in front)
    if blended:
        walked = [f"{row.T:.4f}", f"{row.weight:.4f}", _dot(row.color), _dot(row.cumulative)]
        walked += [f"{row.v_alpha:+.1e}", f"{row.v_opacity:+.1e}"]
        body += "".join(f"<td>{cell}</td>" for cell in walked)
    else:
        body += f'<td class="why" colspan="6">{row.status}, {escape(row.reason)}</td>'
    pull = "" if row.pop == "none" else f'<span class="{row.pop}">{row.pop} {abs(row.v_opacity_pop):.1e}</span>'
    pull = f"<td>{pull}</td>" if has_pop else ""
    body += f'<td>{row.v_opacity_view:+.1e}</td>{pull}<td class="{row.net}">{row.net}</td>'
    return f'<tr class="{" ".join(kinds)}" data-id="{row.id}" tabindex="0">{body}</tr>'


def _dot(color: Sequence[float]) -> str:
    values = " ".join(f"{c:.3f}" for c in color)
    return f'<span class="swatch" title="{values}" style="background:{css_color(color)}"></span>'


def _map(entry: Map) -> str:
    bar = ""
    if entry.scale is not None:
        from matplotlib import colormaps

        name, low, top = entry.scale
        stops = np.round(colormaps[name](np.linspace(0.0, 1.0, 10))[:, :3] * 255.0).astype(int)
        colors = ",".join(f"rgb({r},{g},{b})" for r, g, b in stops.tolist())
        gradient = f"linear-gradient(90deg,{colors})"
        bar = f'<div class="bar">{_short(low)}<i style="background:{gradient}"></i>{_short(top)}</div>'
    lossless = entry.name in ("dominant_ids", "importance_gaussians")
    picture = data_uri(fit(entry.picture, nearest=lossless, max_side=480), lossless=lossless)
    return (
        f'<figure><img alt="{escape(entry.title)}" src="{picture}"><b>{escape(entry.title)}</b>{bar}'
        f'<div class="caption">{escape(entry.about)}</div></figure>'
    )


def _short(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100.0 else f"{value:.3g}"
