"""Draw docs/demo.png from a finished demo run: one held-out view before training, after it, and as it was photographed.

The same render and photograph, without a word, are kept for chapter 0 of the walk-through.

make demo && python docs/picture.py out/demo
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch
from PIL import Image

from pop_fast.api.backend import get_backend
from pop_fast.data.gaussians import initialize_params
from pop_fast.data.load import load_capture
from pop_fast.io.images import id_colors
from pop_fast.train.config import TrainConfig
from pop_fast.train.views import ViewTensors, render_view

mpl.use("Agg")
from matplotlib import pyplot as plt

TARGET = Path(__file__).resolve().parent / "demo.png"
OF_CHAPTER = TARGET.parents[1] / "pop_ref" / "walkthrough" / "trained.png"


def before(result: Path, view: int) -> np.ndarray:
    """Render a held-out view of the Gaussians that training began with. [H, W, 3] in [0, 1]"""
    config = TrainConfig.from_json((result / "cfg.json").read_text(encoding="utf-8"))
    capture = load_capture(config.data, factor=config.factor, normalize=config.normalize)
    params = initialize_params(capture, config.seed, config.init_opacity, config.init_scale)
    with torch.no_grad():
        made = render_view(
            get_backend("fast"), params, ViewTensors.of(capture.test_views(config.test_every)[view]), config, 0
        )
    return made.image.clamp(0.0, 1.0).numpy()


def data_of(result: Path, view: int) -> Path:
    """Find the maps of a held-out view after the last step."""
    return sorted((result / "report_data").glob(f"val_step*_{view:04d}.npz"))[-1]


def side_by_side(result: Path, view: int = 0) -> bytes:
    """Put the render of a held-out view to the left of its photograph; PNG."""
    with np.load(data_of(result, view)) as kept:
        both = np.hstack([kept["render"], kept["photo"]])
    buffer = io.BytesIO()
    Image.fromarray(both).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def draw(result: Path, view: int = 0) -> bytes:
    """Compose the picture of one held-out view of a result folder; PNG with 256 colours."""
    with np.load(data_of(result, view)) as kept:
        photo, render, ids = kept["photo"], kept["render"], kept["dominant_ids"]
        psnr = float(kept["psnr"])
    parts = (
        ("before training: one Gaussian a point", before(result, view)),
        (f"after a minute on two cores: {psnr:.1f} dB", render),
        ("the photograph, never seen in training", photo),
        ("the dominant Gaussian of each pixel", id_colors(ids)),
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
    for target, made in ((TARGET, draw), (OF_CHAPTER, side_by_side)):
        target.write_bytes(made(Path(sys.argv[1]), *map(int, sys.argv[2:3])))
        print(f"{target}: {target.stat().st_size / 1000:.0f} kB")
