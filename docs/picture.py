"""Draw docs/demo.png from a finished demo run: photograph, render, error, dominant Gaussians of one held-out view.

make demo && python docs/picture.py out/demo
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
from PIL import Image

from pop_fast.view.pictures import error_magnitude, error_picture, id_colors

mpl.use("Agg")
from matplotlib import pyplot as plt

TARGET = Path(__file__).resolve().parent / "demo.png"
_ERROR_TOP = 0.25


def draw(result: Path, view: int = 0) -> bytes:
    """Compose the picture of one held-out view of a result folder; PNG with 256 colours."""
    path = sorted((result / "report_data").glob(f"val_step*_{view:04d}.npz"))[-1]
    with np.load(path) as kept:
        photo, render, ids = kept["photo"], kept["render"], kept["dominant_ids"]
        psnr = float(kept["psnr"])
    parts = (
        ("photograph, never seen in training", photo),
        (f"render, {psnr:.1f} dB", render),
        ("error", error_picture(error_magnitude(render, photo), _ERROR_TOP)),
        ("the Gaussian that owns each pixel", id_colors(ids)),
    )
    height, width = photo.shape[:2]
    figure, axes = plt.subplots(1, 4, figsize=(4 * width / 100, (height + 24) / 100), dpi=100)
    for axis, (title, picture) in zip(axes, parts, strict=True):
        axis.imshow(picture, interpolation="nearest")
        axis.set_axis_off()
        axis.text(0.5, -0.03, title, transform=axis.transAxes, ha="center", va="top", fontsize=9, color="#666666")
    figure.subplots_adjust(left=0, right=1, top=1, bottom=24 / (height + 24), wspace=0.02)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", transparent=False)
    plt.close(figure)
    small = io.BytesIO()
    Image.open(buffer).convert("RGB").quantize(256, dither=Image.Dither.FLOYDSTEINBERG).save(
        small, "PNG", optimize=True
    )
    return small.getvalue()


if __name__ == "__main__":
    TARGET.write_bytes(draw(Path(sys.argv[1]), *map(int, sys.argv[2:3])))
    print(f"{TARGET}: {TARGET.stat().st_size / 1000:.0f} kB")
