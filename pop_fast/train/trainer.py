"""The training loop on the CPU: draw a view, render, compare, step, let the strategy edit the population."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any

from tqdm import tqdm

from pop_fast.data.capture import Capture
from pop_fast.errors import PopError
from pop_fast.train.config import TrainConfig
from pop_fast.train.evaluate import gaussians_per_pixel
from pop_fast.train.metrics import psnr
from pop_fast.train.model import adam_step
from pop_fast.train.objective import Objective
from pop_fast.train.schedule import active_sh_degree
from pop_fast.train.training_run import TrainingRun
from pop_fast.train.views import Rendered, ViewTensors, render_view


@dataclass(frozen=True)
class Step:
    """What one training step did."""

    step: int
    index: int
    view: ViewTensors
    loss: float
    regularizer: float | None
    rendered: Rendered
    sh_degree: int
    event: dict[str, Any] | None


class Trainer(TrainingRun):
    """Trains one capture on the CPU.

    Everything random comes from generators that are seeded by the config and saved in checkpoints; the same config,
    capture, machine and number of threads give the same bits, whether a run was interrupted or not.
    """

    def __init__(self, config: TrainConfig, capture: Capture, **options: Any) -> None:
        """Prepare a run; see `TrainingRun`. Backend "auto" is "fast" here; `choose_backend` looks for a faster one."""
        super().__init__(replace(config, backend="fast") if config.backend == "auto" else config, capture, **options)
        self._objective = Objective(self.config, self._train)

    def train_step(self) -> Step:
        """Take one step: render, loss, backward, Adam, strategy."""
        step, config = self.step, self.config
        index = self._order.next()
        view = self._train[index]
        degree = active_sh_degree(step, config.sh_interval, config.sh_degree)
        rendered = self._render(view, degree, counts=step % config.log_every == 0)
        loss = self._objective(rendered.image, index, step)
        term = self.strategy.regularizer(rendered.opacities, self.state, step, rendered.info)
        if term is not None:
            loss = loss + term
        self.strategy.step_pre_backward(self.params, self.optimizers, self.state, step, rendered.info)
        loss.backward()
        value = loss.item()
        if not math.isfinite(value):
            self._require_finite()
            raise PopError(f"the loss of view {view.name} is {value} at step {step}; {self._what_is_left}")
        adam_step(self.params, self.optimizers, config.lr, self._scene_scale, step, config.max_steps, degree)
        self.strategy.step_post_backward(self.params, self.optimizers, self.state, step, rendered.info)
        self.step += 1
        regularizer = None if term is None else term.item()
        return Step(step, index, view, value, regularizer, rendered, degree, self.state["event"])

    def _render(self, view: ViewTensors, degree: int, counts: bool) -> Rendered:
        dominance = self.strategy.needs_dominance(self.step)
        try:
            return render_view(self._backend, self.params, view, self.config, degree, dominance, counts)
        except ValueError:
            self._require_finite()
            raise

    def _advance(self, bar: tqdm) -> None:
        # a method of its own, so that this step's render is let go of before the next one is made
        start = time.perf_counter()
        done = self.train_step()
        self._train_seconds += time.perf_counter() - start
        if done.event is not None or done.step % self.config.log_every == 0:
            self._log(done, time.perf_counter() - start, bar)
        bar.update()

    def _log(self, done: Step, seconds: float, bar: tqdm) -> None:
        blended, traversed = gaussians_per_pixel(done.rendered.info)
        image = done.rendered.image.detach()
        record = {
            "step": done.step,
            "view": done.view.name,
            "loss": done.loss,
            **self._objective.terms(image, done.index, done.step),
            **({} if done.regularizer is None else {"pop": done.regularizer}),
            "psnr": psnr(image, done.view.target(), done.view.mask),
            "num_gaussians": len(self.params["means"]),
            "n_blended": blended,
            "n_traversed": traversed,
            "sh_degree": done.sh_degree,
            "lr_means": self.optimizers["means"].param_groups[0]["lr"],
            "it_per_s": 1.0 / seconds,
            "seconds": self._train_seconds,
            **(done.event or {}),
        }
        self._results.log(record)
        bar.set_postfix_str(f"PSNR {record['psnr']:.2f}, N {record['num_gaussians']:,}", refresh=False)
