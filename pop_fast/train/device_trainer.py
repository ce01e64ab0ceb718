"""Training on a GPU: the device takes all steps up to the next event by itself, then the host edits the population.

Parameters, moments and statistics stay on the device. What a checkpoint, a record or a statistics file means is what
`Trainer` means by it; a run goes on from a checkpoint to the same bits. Two things are not in the records of
metrics.jsonl: Gaussians per pixel, which would take a render of their own (they are measured on the held-out views).
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from tqdm import tqdm

from cuda_ext.train_settings import Phase
from pop_fast.data.capture import Capture
from pop_fast.density import blur_set
from pop_fast.errors import PopError
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.config import TrainConfig
from pop_fast.train.device_plan import changes_after, phase_at, step_settings, stretch_end, unsupported
from pop_fast.train.hardware import Hardware, Stepper, this_machine
from pop_fast.train.model import KEYS, make_optimizers
from pop_fast.train.on_device import OnDevice, words_for_memory
from pop_fast.train.schedule import ViewOrder, means_lr
from pop_fast.train.training_run import TrainingRun
from pop_fast.train.views import ViewTensors


class DeviceTrainer(TrainingRun):
    """Trains one capture on a GPU."""

    def __init__(
        self, config: TrainConfig, capture: Capture, *, hardware: Hardware | None = None, **options: Any
    ) -> None:
        """Prepare a run; see `TrainingRun`. Backend "auto" is "cuda" here.

        Raises:
            PopError: there is no GPU or build to run on, or the fused step does not know a setting.
        """
        reason = unsupported(config)
        if reason is not None:
            raise PopError(reason)
        self._hardware = this_machine() if hardware is None else hardware
        self._device = self._hardware.device
        options["backend"] = OnDevice(self._hardware.backend, self._device)
        super().__init__(replace(config, backend="cuda"), capture, **options)
        self._stepper: Stepper | None = None

    def _begin(self) -> None:
        super()._begin()
        start = time.perf_counter()
        with words_for_memory():
            self._place()
            self._bind()
        self._loading_seconds += time.perf_counter() - start

    def _place(self) -> None:
        """Move parameters, moments and statistics to the device."""
        moments = ckpt.pack_optimizers(self.optimizers)
        self.params = {key: Parameter(self.params[key].detach().to(self._device)) for key in KEYS}
        self.optimizers = make_optimizers(self.params, self.config.lr, self._scene_scale)
        for key, param in self.params.items():
            names = ("exp_avg", "exp_avg_sq")
            given = {name: moments[key].get(name, torch.zeros_like(param)).to(self._device) for name in names}
            self.optimizers[key].state[param] = {"step": torch.tensor(float(self.step)), **given}
        for key, value in self.state.items():
            self.state[key] = value.to(self._device) if isinstance(value, Tensor) else value

    def _bind(self) -> None:
        """Hand the rows as they are now to what takes the steps."""
        rows = {key: param.detach() for key, param in self.params.items()}
        moments = {key: self.optimizers[key].state[self.params[key]] for key in KEYS}
        m, v = ({key: moments[key][name] for key in KEYS} for name in ("exp_avg", "exp_avg_sq"))
        if self._stepper is None:
            settings = step_settings(self.config, self._scene_scale)
            order = self._upcoming()
            self._stepper = self._hardware.make_stepper(rows, m, v, self._train, order, settings, self.step)
        else:
            self._stepper.rebind(rows, m, v)
        self._give_statistics()

    def _upcoming(self) -> list[int]:
        """Return the view of every step; those of steps taken are not known any more, and 0."""
        ahead = ViewOrder(len(self._train), self.config.seed)
        ahead.load_state_dict(self._order.state_dict())
        return [0] * self.step + [ahead.next() for _ in range(self.step, self.config.max_steps)]

    def _advance(self, bar: tqdm) -> None:
        start = time.perf_counter()
        first, end = self.step, stretch_end(self.config, self.step)
        phase = phase_at(self.config, first)
        views = [self._train[self._order.next()] for _ in range(first, end)]
        self._run(end, phase)
        self._take_statistics(phase, views)
        before = len(self.params["means"])
        event = self._change(end - 1)
        seconds = time.perf_counter() - start
        self._log(first, views, phase, before, event, seconds, bar)
        self._train_seconds += seconds
        bar.update(end - first)

    def _run(self, end: int, phase: Phase) -> None:
        assert self._stepper is not None
        try:
            with words_for_memory():
                self._stepper.run(end, phase)
        except ValueError as error:
            if isinstance(error, PopError):
                raise
            # a row that is not finite halts the device, so that the parameters still say which entry it is
            self.step = self._stepper.step
            self._require_finite()
            raise PopError(f"{error}; {self._what_is_left}") from error
        self.step = end

    def _change(self, step: int) -> dict[str, Any] | None:
        self.state["event"] = None
        if changes_after(self.config, step):
            with words_for_memory():
                self.strategy.change(self.params, self.optimizers, self.state, step)
                self._bind()
        return self.state["event"]

    def _take_statistics(self, phase: Phase, views: Sequence[ViewTensors]) -> None:
        """Copy what the device collected into the strategy's state, in the strategy's own types."""
        assert self._stepper is not None
        state, found = self.state, self._stepper.statistics
        if phase.statistics:
            state["grad2d"], state["count"] = found.grad_sum.clone(), found.n_visible.to(found.grad_sum.dtype)
            state["views"] += len(views)
        plan, summed = self.config.strategy, phase.blur and self.config.strategy.blur_window == "sum"
        if summed or phase.window:
            state["dominant_sum"] = found.dominant_sum.long()
        if not phase.blur:
            return
        if summed:
            height, width = views[-1].height, views[-1].width
            bound = (plan.theta_blur, plan.blur_min_pixels, views[-1].kept_pixels)
            state["blurred"] = blur_set(state["dominant_sum"], width, height, *bound)
        else:
            state["blurred"] = found.blurred.bool()

    def _give_statistics(self) -> None:
        """Let the device go on from the strategy's state: after a checkpoint, or a change that kept the window."""
        assert self._stepper is not None
        found = self._stepper.statistics
        given = {"grad2d": found.grad_sum, "count": found.n_visible, "dominant_sum": found.dominant_sum}
        for key, target in {**given, "blurred": found.blurred}.items():
            if self.state.get(key) is not None:
                target.copy_(self.state[key])

    def _log(
        self,
        first: int,
        views: Sequence[ViewTensors],
        phase: Phase,
        before: int,
        event: dict[str, Any] | None,
        seconds: float,
        bar: tqdm,
    ) -> None:
        """Write the records of a stretch, from what the device kept of its steps."""
        assert self._stepper is not None
        lr, last = self.config.lr, self.step - 1
        for step, view, told in zip(range(first, self.step), views, self._stepper.told(first, self.step), strict=True):
            loss = told.objective + told.pop
            if not math.isfinite(loss):
                self._require_finite()
                raise PopError(f"the loss of view {view.name} is {loss} at step {step}; {self._what_is_left}")
            changed = event if step == last else None
            if step % self.config.log_every != 0 and changed is None:
                continue
            halved = 0.5 if self.config.d_ssim_halved else 1.0
            record = {
                "step": step,
                "view": view.name,
                "loss": loss,
                "l1" if phase.l1 else "l2": told.pixelwise,
                "d_ssim": halved * (1.0 - told.ssim),
                **({"pop": told.pop} if phase.pop else {}),
                "psnr": -10.0 * math.log10(told.square) if told.square > 0.0 else math.inf,
                "num_gaussians": before if changed is None else len(self.params["means"]),
                "sh_degree": phase.sh_degree,
                "lr_means": means_lr(step, self.config.max_steps, lr.means * self._scene_scale, lr.means_decay),
                "it_per_s": len(views) / seconds,
                "seconds": self._train_seconds + seconds * (step + 1 - first) / len(views),
                **(changed or {}),
            }
            self._results.log(record)
            bar.set_postfix_str(f"PSNR {record['psnr']:.2f}, N {record['num_gaussians']:,}", refresh=False)

    def _facts(self) -> dict[str, Any]:
        grown = 0 if self._stepper is None else self._stepper.grown
        return {**super()._facts(), **self._hardware.facts(), "instance_buffers_grown": grown}

    def _save(self) -> None:
        for key, param in self.params.items():
            self.optimizers[key].state[param]["step"].fill_(float(self.step))
        super()._save()
