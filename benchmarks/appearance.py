"""What exposure, random backgrounds and corrected cameras change where there are few photographs.

    python benchmarks/appearance.py scene --factor 8 --steps 1000
    python benchmarks/appearance.py scene --gains 0.3 --only plain --only "--exposure"
    python benchmarks/appearance.py scene --turned 0.3 --only plain --only "--refine-cameras"

Every eighth photograph is held out, of the others every other one is left out, and a run is made with each setting.
Prints a row of a Markdown table for each: held-out PSNR, the same after fitting colours, SSIM, Gaussians. Good captures
have little for these settings to put right, so photographs can be made brighter and darker at random, and training
cameras turned.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from pop_fast.api.registry import get_backend
from pop_fast.data import Capture, View, load_capture
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.choose import choose_backend
from pop_fast.train.evaluate import evaluate
from pop_fast.train.views import ViewTensors

SETTINGS: Final[dict[str, dict[str, Any]]] = {
    "plain": {},
    "--exposure": {"exposure": True},
    "--random-background": {"random_background": True},
    "--exposure --appearance-lr.exposures 1e-3": {"exposure": True, "appearance_lr.exposures": 1e-3},
    "--refine-cameras": {"refine_cameras": True},
    "--refine-cameras --appearance-lr.cameras 1e-4": {"refine_cameras": True, "appearance_lr.cameras": 1e-4},
    "--refine-cameras --appearance-lr.cameras 1e-3": {"refine_cameras": True, "appearance_lr.cameras": 1e-3},
    "--exposure --refine-cameras": {"exposure": True, "refine_cameras": True},
}


def thinned(capture: Capture, test_every: int = 8) -> Capture:
    """Leave every other training photograph out; the same ones stay held out."""
    held_out = {view.name for view in capture.test_views(test_every)}
    views = [replace(view, split="train") for view in capture.train_views(test_every)[::2]]
    views += [replace(view, split="test") for view in capture.views if view.name in held_out]
    return replace(capture, views=tuple(views))


def disturbed(capture: Capture, gains: float, turned: float) -> Capture:
    """Disturb a capture, the same way at every call.

    Args:
        capture: with a split.
        gains: every photograph is multiplied by a number drawn from 1 - gains to 1.
        turned: training cameras are turned by angles of this standard deviation about each axis, degrees.
    """
    draw = np.random.default_rng(0)
    views: list[View] = []
    for view in capture.views:
        image = np.rint(view.image * draw.uniform(1.0 - gains, 1.0)).astype(np.uint8)
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(np.radians(draw.normal(0.0, turned, 3))).as_matrix()
        viewmat = turn @ view.viewmat if view.split == "train" else view.viewmat
        views.append(replace(view, image=image, viewmat=viewmat))
    return replace(capture, views=tuple(views))


def main(words: list[str] | None = None) -> int:
    """Measure, a row for each setting."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--factor", type=int, default=8)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--gains", type=float, default=0.0)
    parser.add_argument("--turned", type=float, default=0.0, help="degrees")
    parser.add_argument("--only", choices=SETTINGS, action="append")
    args = parser.parse_args(words)
    capture = disturbed(thinned(load_capture(args.capture, factor=args.factor)), args.gains, args.turned)
    print(f"{capture.name}: {len(capture.train_views())} photographs, {len(capture.test_views())} held out", flush=True)
    print("| setting | PSNR | colours fitted | SSIM | Gaussians |\n| --- | --- | --- | --- | --- |", flush=True)
    for name in args.only or SETTINGS:
        with TemporaryDirectory() as folder:
            settings = {"preset": "quick", "steps_scaler": args.steps / 30_000, "seed": args.seed, **SETTINGS[name]}
            given = TrainConfig.of(**settings, data=str(args.capture), result_dir=f"{folder}/run", progress=False)
            config = choose_backend(replace(given, checkpoint_every=0))[0]
            run = TrainingRun(config, capture)
            run.run()
            # measured with colours fitted whether or not the run asked for it
            views, drawing = [ViewTensors.of(view) for view in capture.test_views()], get_backend(config.backend)
            measured = evaluate(
                drawing, run.params, views, replace(config, given=None, exposure=True), config.sh_degree
            )
        numbers = (f"{measured['psnr']:.2f}", f"{measured['cc_psnr']:.2f}", f"{measured['ssim']:.4f}")
        print(f"| `{name}` | {' | '.join(numbers)} | {len(run.params['means']):,} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
