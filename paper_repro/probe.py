"""A training that looks at a few fixed views as it goes: the gradients of each loss, and Gaussians per pixel.

A step's own record is of the one view that it trained on, and engines that take the whole step at once neither count
what a pixel visits nor take the losses apart. So the same views are rendered every so often, and what they say is kept
next to the records; figures 4a and 4b are made of it. The training itself is not touched, and its seconds do not
contain this.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor

from paper_repro.collect import PROBE, read_probe
from pop_fast.data import Capture
from pop_fast.io.atomic import write_file
from pop_fast.stages import losses
from pop_fast.train.config import TrainConfig
from pop_fast.train.engines import engine_of
from pop_fast.train.evaluate import gaussians_per_pixel
from pop_fast.train.results import Segment
from pop_fast.train.schedule import active_sh_degree
from pop_fast.train.training_run import TrainingRun
from pop_fast.train.views import ViewTensors, render_view
from pop_ref.settings import Recipe

# training views, evenly over their names: one alone would say what it alone is like
VIEWS: Final = 3


class ProbedRun(TrainingRun):
    """A run that renders `VIEWS` training views before every `every`-th step, and writes what they say to probe.json.

    What was probed before a run was stopped is taken up where the run itself continues.
    """

    def __init__(self, config: TrainConfig, capture: Capture, *, every: int, **more: Any) -> None:
        """Prepare a run.

        Args:
            config: the settings, with a backend's name.
            capture: the photographs and cameras.
            every: steps between two probes.
            more: as `TrainingRun` takes it.
        """
        engine = engine_of(config)
        super().__init__(config, capture, engine=engine, **more)
        views = capture.train_views(config.test_every)
        chosen = sorted({round(i * (len(views) - 1) / max(VIEWS - 1, 1)) for i in range(VIEWS)})
        self._probed = [ViewTensors.of(views[i], self.params["means"].dtype) for i in chosen]
        self._renderer, self._device, self._every = engine.backend, engine.device, every
        self._path = Path(config.result_dir) / PROBE
        self._points: dict[int, Mapping[str, float]] | None = None
        self._written = 0

    def run(self) -> dict[str, Any]:
        """See `TrainingRun.run`."""
        try:
            return super().run()
        finally:
            self._write()

    def take_steps(self, last: int) -> Segment:
        """See `TrainingRun.take_steps`; a segment ends where a probe is due."""
        if self._points is None:
            # what was probed before the step that the run continues from
            self._points = {step: of for step, of in read_probe(self._path.parent).items() if step < self.step}
        if self.step % self._every == 0:
            self._points[self.step] = self._probe()
        self._write()
        return super().take_steps(min(last, (self.step // self._every + 1) * self._every))

    def _probe(self) -> Mapping[str, float]:
        config = self.config
        degree = active_sh_degree(self.step, config.sh_interval, config.sh_degree, config.strategy.sh_start_iter)
        sums: dict[str, float] = {}
        for view in self._probed:
            with torch.no_grad():
                rendered = render_view(self._renderer, self.params, view, config, degree, counts=True)
            blended, traversed = gaussians_per_pixel(rendered.info)
            found = gradient_sizes(*self._placed(rendered.image, view), config.ssim_padding)
            for name, value in {**found, "probe_blended": blended, "probe_traversed": traversed}.items():
                sums[name] = sums.get(name, 0.0) + value / len(self._probed)
        return {"num_gaussians": len(self.params["means"]), **sums}

    def _placed(self, image: Tensor, view: ViewTensors) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return a render, the photograph and its mask where training computes; windows take long on one CPU thread."""
        mask = None if view.mask is None else view.mask.to(self._device)
        return image.to(self._device), view.target().to(self._device), mask

    def _write(self) -> None:
        # nothing is written into a folder that the run itself has not begun
        if not self._points or len(self._points) == self._written or not self._path.with_name("cfg.json").is_file():
            return
        write_file(self._path, json.dumps(self._points))
        self._written = len(self._points)


def gradient_sizes(
    image: Tensor, photo: Tensor, mask: Tensor | None = None, padding: losses.Padding = "valid"
) -> dict[str, float]:
    """Measure how large the gradient of each term of the losses with respect to the image is.

    The mean of |dL/dC| over pixels and channels, in units of 1/(3HW), the slope of L1: so L1 has 1 wherever render and
    photograph differ, L2 has twice the mean error, and images of any size compare.

    Args:
        image: a render. [H, W, 3]
        photo: the photograph. [H, W, 3]
        mask: True where the photograph counts, or None. [H, W]
        padding: of SSIM's windows.

    Returns:
        grad_l1, grad_l2, and grad_ssim with POP's weight of 0.01.
    """
    found = {
        "grad_l1": losses.l1_vjp(image, photo, 1.0, mask),
        "grad_l2": losses.l2_vjp(image, photo, 1.0, mask),
        "grad_ssim": losses.d_ssim_vjp(image, photo, Recipe.lambda_ssim, padding, mask),
    }
    return {name: float(gradient.abs().sum(dtype=torch.float64)) for name, gradient in found.items()}
