"""SVG over pictures: a splat's ellipses, the mark on the pixel, and the bar of weights."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pop_fast.view.explain.model import PixelExplanation, Row
from pop_fast.view.pictures import data_uri, id_colors
from pop_fast.view.svg import element
from pop_ref.constants import PROFILES

Box = tuple[int, int, int, int]


def stage(e: PixelExplanation, rows: Sequence[Row], picture: np.ndarray, box: Box, inner: Box | None) -> str:
    """Lay ellipses and the pixel's mark over a picture.

    Args:
        e: the explanation.
        rows: the splats to draw, the heaviest first.
        picture: uint8, of the part `box` of the view.
        box: left, top, width and height, px.
        inner: a part to outline, or None for a close-up.
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
    return element("svg", body, kind="light", viewBox="0 0 1000 74", preserveAspectRatio="none", role="img")


def css_color(color: Sequence[float]) -> str:
    """Write a colour as #rrggbb, clamped."""
    return "#" + "".join(f"{round(255 * min(max(c, 0.0), 1.0)):02x}" for c in color)
