"""Results side by side: one row a run, from the statistics of its last step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from pop_fast.train.presets import ALIASES, METHODS

COLUMNS: Final = (
    "capture",
    "method",
    "λ",
    "steps",
    "PSNR",
    "SSIM",
    "Gaussians",
    "with opacity ≥ 1/255",
    "per pixel: blended / traversed",
    "opacity > 0.9 / < 0.1",
    "seconds",
    "machine",
)
_TEXT: Final = frozenset({"capture", "method", "machine"})


def row(stats: Mapping[str, Any]) -> list[str]:
    """Write one run's statistics (stats/val_step*.json) as the cells of a row; what is absent becomes a dash."""

    def cell(form: str, *keys: str) -> str:
        values = [stats.get(key) for key in keys]
        return "–" if any(value is None for value in values) else form.format(*values)

    steps = stats.get("step")
    method = str(stats.get("method", "–"))
    machine = [str(stats.get("machine", "–")), *([stats["backend"]] if stats.get("backend") else [])]
    machine += [threads_of(stats)] if "threads" in stats else []
    return [
        str(stats.get("capture", "–")),
        METHODS[name].title.split(" (")[0] if (name := ALIASES.get(method, method)) in METHODS else method,
        "–" if not stats.get("lambda_pop") else f"{stats['lambda_pop']:g}",
        "–" if steps is None else _steps(steps + 1, stats.get("max_steps")),
        cell("{:.2f}", "psnr"),
        cell("{:.4f}", "ssim"),
        cell("{:,}", "num_GS"),
        cell("{:,}", "num_GS_above_floor"),
        cell("{:.1f} / {:.1f}", "n_blended", "n_traversed"),
        cell("{:.0%} / {:.0%}", "opacity_above_0.9", "opacity_below_0.1"),
        cell("{:,.0f}", "seconds"),
        ", ".join(machine),
    ]


def _steps(taken: int, planned: Any) -> str:
    """Write how many steps a row is of, and of how many where the run has not come to its end."""
    return f"{taken:,}" if not isinstance(planned, int) or taken >= planned else f"{taken:,} of {planned:,}, unfinished"


def threads_of(stats: Mapping[str, Any]) -> str:
    """Write how many threads a run had."""
    return f"{stats['threads']} thread{'' if stats['threads'] == 1 else 's'}"


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """Lay rows out as a Markdown table, numbers to the right."""
    rule = ["---" if name in _TEXT else "---:" for name in COLUMNS]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (COLUMNS, rule, *rows))


def plain(rows: Sequence[Sequence[str]]) -> str:
    """Lay rows out in columns for a terminal."""
    table = [COLUMNS, *rows]
    widths = [max(len(cells[i]) for cells in table) for i in range(len(COLUMNS))]
    lines: list[str] = []
    for cells in table:
        padded = (
            cell.ljust(width) if name in _TEXT else cell.rjust(width)
            for name, cell, width in zip(COLUMNS, cells, widths, strict=True)
        )
        lines.append("  ".join(padded).rstrip())
    return "\n".join(lines)
