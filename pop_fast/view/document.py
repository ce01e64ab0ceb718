"""Pages that hold all that they show: one style, one script, SVG, and a policy by which nothing else runs.

Curves and histograms are drawn without a library, in colours of the page's CSS variables. Each chart carries its data
as JSON in `data-chart`, which the page's few lines of script (page.js) read for the crosshair. With scripts off the
chart is still complete.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from typing import Final

# pictures and videos are in the page; whatever else a text of a result or of a capture could bring along is neither
# fetched nor run
_POLICY: Final = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:; base-uri 'none'; "
    "form-action 'none'; script-src {scripts}"
)
# the page that shows a splat sorts in a worker, and a frame is held to the policy of the page around it as well
_WORKERS: Final = " blob:; worker-src blob:"


def document(title: str, style: str, body: str, script: str, framed: str = "") -> str:
    """Lay out a page of a title as text, a style sheet, HTML for `main`, and the one script that may run in it.

    `framed` is the script that may run in its frames, which may start workers; empty for none.
    """
    digests = [hashlib.sha256(text.encode()).digest() for text in (script, framed) if text]
    allowed = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    policy = _POLICY.format(scripts=allowed) + (_WORKERS if framed else "")
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        f"<title>{escape(title)}</title><style>{style}</style></head>"
        f"<body><main>{body}</main><script>{script}</script></body></html>\n"
    )


def asset(folder: str, name: str) -> str:
    return files("pop_fast.view").joinpath(folder, name).read_text(encoding="utf-8")


def element(tag: str, body: str = "", title: str = "", **attributes: object) -> str:
    """Write one element, with a title that browsers show under the pointer.

    In attributes `kind` becomes `class`, `_` becomes `-`, and numbers are rounded to 0.1.
    """
    words = [tag]
    for name, value in attributes.items():
        text = f"{value:.1f}".removesuffix(".0") if isinstance(value, float) else str(value)
        words.append(f'{"class" if name == "kind" else name.replace("_", "-")}="{escape(text)}"')
    if title:
        body = f"<title>{escape(title)}</title>" + body
    return f"<{' '.join(words)}>{body}</{tag}>" if body else f"<{' '.join(words)}/>"


def text(x: float, y: float, words: str, anchor: str = "start") -> str:
    return element("text", escape(words), x=float(x), y=float(y), text_anchor=anchor)


def path(d: str, kind: str, title: str = "", **attributes: object) -> str:
    return element("path", "", title, kind=kind, d=d, **attributes)


def card(title: str, legend: str, width: int, height: int, body: str, kind: str = "chart", data: str = "") -> str:
    """Write a figure: a title with its legend, and an SVG drawing of a size in its own units under it.

    `kind` are CSS classes of the figure, `data` is JSON that the page's script reads.
    """
    extra = f' data-chart="{escape(data)}"' if data else ""
    drawing = element("svg", body, role="img", aria_label=title, viewBox=f"0 0 {width} {height}")
    caption = f'<figcaption><b>{escape(title)}</b><span class="legend">{legend}</span></figcaption>'
    return f'<figure class="{kind}"{extra}>{caption}{drawing}</figure>'


WIDTH: Final = 440
HEIGHT: Final = 220
_LEFT, _RIGHT, _TOP, _BOTTOM = 44, 12, 28, 28
_LANE: Final = 5


@dataclass(frozen=True)
class Series:
    """One line of a chart: iterations, and values, where NaN leaves a gap.

    With `dots`, points are joined by a thin line in the place of a line, for values that are measured now and then.
    """

    name: str
    x: Sequence[float]
    y: Sequence[float]
    color: str
    dots: bool = False


@dataclass(frozen=True)
class Window:
    """A shaded stretch of the schedule, in iterations: [start, stop]."""

    name: str
    start: float
    stop: float
    color: str


@dataclass(frozen=True)
class Chart:
    """A chart to draw."""

    title: str
    series: Sequence[Series]
    x_stop: float  # the last iteration of the axis
    windows: Sequence[Window] = field(default_factory=tuple)  # shaded stretches
    marks: Sequence[float] = field(default_factory=tuple)  # iterations with a dashed line (opacity resets)
    log: bool = False  # a logarithmic y axis
    zero: bool = False  # let the y axis start at zero
    unit: str = ""  # written after values under the pointer


def nice_ticks(low: float, high: float, n: int = 5) -> list[float]:
    """Choose about n round numbers (1, 2, 2.5 or 5 times a power of ten) that lie in [low, high]."""
    if not high > low:
        return [low]
    raw = (high - low) / max(n, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * power >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [i * step for i in range(first, last + 1)]


def short_number(value: float) -> str:
    """Write a number as axes do: 1200 -> 1.2k, 2500000 -> 2.5M, 0.00025 -> 2.5e-4."""
    size = abs(value)
    if size >= 1e6:
        return f"{value / 1e6:.3g}M"
    if size >= 1e3:
        return f"{value / 1e3:.3g}k"
    if size == 0.0 or size >= 1e-3:
        return f"{value:.4g}"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa.removesuffix('.0')}e{int(exponent)}"


class _Axes:
    """Pixels from values, for one chart."""

    def __init__(self, chart: Chart) -> None:
        values = [v for s in chart.series for v in s.y if math.isfinite(v) and (v > 0 or not chart.log)]
        low, high = (min(values), max(values)) if values else (0.0, 1.0)
        self.log = chart.log
        if chart.log:
            self.low, self.high = math.log10(low) if low > 0 else -1.0, math.log10(high) if high > 0 else 0.0
            pad = max(0.05 * (self.high - self.low), 0.02)
            self.low, self.high = self.low - pad, self.high + pad
        else:
            # wide enough that its margins are not rounded away, as those of the smallest numbers are
            span = max(high - low or abs(high) or 1.0, sys.float_info.min)
            self.low = 0.0 if chart.zero and low >= 0 else low - 0.06 * span
            self.high = high + 0.08 * span
        self.x_stop = max(chart.x_stop, 1.0)

    def x(self, value: float) -> float:
        return _LEFT + (WIDTH - _LEFT - _RIGHT) * min(max(value / self.x_stop, 0.0), 1.0)

    def y(self, value: float) -> float:
        level = math.log10(value) if self.log else value
        return HEIGHT - _BOTTOM - (HEIGHT - _BOTTOM - _TOP) * (level - self.low) / (self.high - self.low)

    def y_ticks(self) -> list[float]:
        if not self.log:
            return nice_ticks(self.low, self.high, 4)
        # those that a number can have
        decades = range(max(math.floor(self.low), -323), min(math.ceil(self.high), 308) + 1)
        steps = (1.0, 2.0, 5.0) if self.high - self.low < 2.5 else (1.0,)
        ticks = [m * 10.0**d for d in decades for m in steps]
        return [t for t in ticks if self.low <= math.log10(t) <= self.high]


def draw(chart: Chart) -> str:
    """Draw one chart as a `<figure>` with title, legend and SVG."""
    axes = _Axes(chart)
    body = [_shading(chart, axes), _grid(axes), *(_line(series, axes) for series in chart.series)]
    rounded = [[float(f"{v:.6g}") if math.isfinite(v) else None for v in s.y] for s in chart.series]
    data = {
        "stop": axes.x_stop,
        "unit": chart.unit,
        "box": [_LEFT, _RIGHT, _TOP, _BOTTOM, WIDTH, HEIGHT],
        "series": [
            {"n": s.name, "c": s.color, "x": list(s.x), "y": y} for s, y in zip(chart.series, rounded, strict=True)
        ],
    }
    legend = "".join(f'<span><i style="background:{s.color}"></i>{escape(s.name)}</span>' for s in chart.series)
    packed = json.dumps(data, separators=(",", ":"))
    return card(chart.title, legend, WIDTH, HEIGHT, "".join(body), data=packed)


def _shading(chart: Chart, axes: _Axes) -> str:
    parts: list[str] = []
    bottom = HEIGHT - _BOTTOM
    for lane, window in enumerate(chart.windows):
        x0 = axes.x(window.start)
        width = max(axes.x(window.stop) - x0, 1.0)
        bar_y = _TOP - (_LANE + 2) * (lane + 1)
        shade = element("rect", kind="shade", x=x0, y=_TOP, width=width, height=bottom - _TOP)
        bar = element("rect", x=x0, y=bar_y, width=width, height=_LANE, rx=2)
        note = f"{window.name}: {window.start:g} to {window.stop:g}"
        parts.append(element("g", shade + bar, note, fill=window.color))
    for mark in chart.marks:
        parts.append(path(f"M{axes.x(mark):.1f} {_TOP}V{bottom}", "mark", f"opacity reset at {mark:g}"))
    return "".join(parts)


def _grid(axes: _Axes) -> str:
    parts: list[str] = []
    for tick in axes.y_ticks():
        y = axes.y(tick)
        parts.append(path(f"M{_LEFT} {y:.1f}H{WIDTH - _RIGHT}", "grid"))
        parts.append(text(_LEFT - 8, y + 4, short_number(tick), "end"))
    for tick in nice_ticks(0.0, axes.x_stop, 5):
        parts.append(text(axes.x(tick), HEIGHT - 10, short_number(tick), "middle"))
    parts.append(path(f"M{_LEFT} {HEIGHT - _BOTTOM}H{WIDTH - _RIGHT}", "axis"))
    return "".join(parts)


def _line(series: Series, axes: _Axes) -> str:
    strokes: list[str] = []
    dots: list[str] = []
    pen_down = False
    for x, y in zip(series.x, series.y, strict=True):
        if not math.isfinite(y) or (axes.log and y <= 0):
            pen_down = False
            continue
        px, py = axes.x(x), axes.y(y)
        strokes.append(f"{'L' if pen_down else 'M'}{px:.1f} {py:.1f}")
        dots.append(element("circle", "", f"{series.name} at {x:g}: {y:.5g}", cx=px, cy=py, r=3.4))
        pen_down = True
    if not strokes:
        return ""
    drawn = path("".join(strokes), "thin" if series.dots else "line", stroke=series.color)
    with_dots = series.dots or len(dots) == 1
    return drawn + (element("g", "".join(dots), fill=series.color) if with_dots else "")


def draw_histogram(title: str, shares: Sequence[float], top: float, color: str, notes: Sequence[str]) -> str:
    """Draw an opacity histogram: equal bins over [0, 1], bar heights as shares of all Gaussians.

    `top` is the share at the top of the axis, the same in charts that stand side by side; a taller bar is cut off there
    and its share written next to it.
    """
    width, height, left, right, ceiling, bottom = 320, 180, 40, 8, 8, 24
    plot_w, plot_h, floor = width - left - right, height - bottom - ceiling, height - bottom
    grid: list[str] = []
    for tick in nice_ticks(0.0, top, 3):
        y = floor - plot_h * tick / top if top > 0 else floor
        grid.append(path(f"M{left} {y:.1f}H{width - right}", "grid"))
        grid.append(text(left - 6, y + 4, f"{100 * tick:.3g}%", "end"))
    for tick in (0.0, 0.5, 1.0):
        grid.append(text(left + plot_w * tick, height - 7, f"{tick:g}", "middle"))
    bars: list[str] = []
    step = plot_w / max(len(shares), 1)
    for i, share in enumerate(shares):
        tall = plot_h * min(share / top, 1.0) if top > 0 else 0.0
        note = f"{i / len(shares):.2f} to {(i + 1) / len(shares):.2f}: {100 * share:.2f} %"
        x = left + step * i + 0.5
        bars.append(element("rect", "", note, x=x, y=floor - tall, width=step - 1.0, height=tall))
        if share > top:
            grid.append(text(x + step + 4, ceiling + 10, f"{100 * share:.0f} %"))
    remarks = "".join(f"<span>{escape(note)}</span>" for note in notes)
    body = "".join(grid) + element("g", "".join(bars), fill=color)
    return card(title, remarks, width, height, body, kind="chart small")
