"""What stands below a figure: captures, steps, seeds, scale, and whether that is the protocol of the paper."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from paper_repro.figures.data import Asked, Chosen
from paper_repro.figures.style import name_of
from paper_repro.results import Result
from paper_repro.scales import scale_named


def foot(asked: Asked, chosen: Chosen, *more: str, averaged: bool = True) -> str:
    """Write the note of a figure.

    Args:
        asked: what is drawn.
        chosen: of which results.
        more: sentences of the figure's own, in front of the others.
        averaged: whether it shows means over the captures.
    """
    sentences = [*more, *foot_of(asked.scale, chosen.all, averaged)]
    if chosen.left_out:
        sentences.append(f"Not every row was run on {_listed(chosen.left_out)}.")
    if chosen.missing:
        sentences.append(f"Not run: {_listed(map(name_of, chosen.missing))}.")
    return " ".join(sentences)


def foot_of(scale: str, results: Sequence[Result], averaged: bool = True) -> list[str]:
    """Say captures, steps and seeds of results, and the scale."""
    sizes = {
        r.scene: f"{r.scene} ({r.protocol['width']}\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}{r.protocol['height']})"
        for r in results
    }
    steps = sorted({int(r.schedule["max_steps"]) for r in results})
    seeds = sorted({r.seed for r in results})
    of_them = "Capture" if len(sizes) == 1 else "Mean over" if averaged else "Captures"
    captures = f"{of_them} {_listed(sizes.values())}"
    length = " to ".join(f"{n:,}" for n in dict.fromkeys((steps[0], steps[-1])))
    seeded = f"seed {seeds[0]}" if len(seeds) == 1 else f"mean over seeds {_listed(map(str, seeds))}"
    return [f"{captures}; {length} steps; {seeded}.", scale_sentence(scale)]


def scale_sentence(scale: str) -> str:
    """Say whether a scale is the paper's protocol."""
    if scale == "paper":
        return "Scale paper: the published protocol."
    return f"Scale {scale}, not the paper's protocol: {scale_named(scale).about}."


def _listed(names: Iterable[str]) -> str:
    found = list(names)
    return found[0] if len(found) == 1 else f"{', '.join(found[:-1])} and {found[-1]}"
