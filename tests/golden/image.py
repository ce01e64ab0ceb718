"""The golden image: one 16 x 16 scene as the oracle draws it, as text; run as a module to print it again."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pop_ref.conformance.adapter import View, oracle_view
from pop_ref.conformance.scenes import golden_scene

FILE = Path(__file__).with_suffix(".txt")
HEADER = "# column row: red green blue, light left, Gaussian that dominates; made by python -m tests.golden.image"


def as_text(view: View) -> str:
    """Write a render, a pixel a line."""
    H, W = view.T_final.shape
    lines = [HEADER]
    for y in range(H):
        for x in range(W):
            numbers = [*view.image[y, x].tolist(), float(view.T_final[y, x])]
            lines.append(f"{x} {y}: {' '.join(repr(n) for n in numbers)} {int(view.dominant_ids[y, x])}")
    return "\n".join(lines) + "\n"


def written() -> View:
    """Read the file."""
    scene = golden_scene()
    H, W = scene.camera.height, scene.camera.width
    image, T_final, ids = np.zeros((H, W, 3)), np.zeros((H, W)), np.zeros((H, W), dtype=np.int64)
    for line in FILE.read_text(encoding="utf-8").splitlines()[1:]:
        place, _, values = line.partition(": ")
        x, y = (int(n) for n in place.split())
        *color, left, winner = values.split()
        image[y, x], T_final[y, x], ids[y, x] = [float(c) for c in color], float(left), int(winner)
    return View(image, T_final, ids)


if __name__ == "__main__":
    print(as_text(oracle_view(golden_scene())), end="")
