"""Training steps by autograd over a backend's stages: every setting, and strategies of other people.

A step may be over several views, drawn by one process or by several to the same bits.
Its loss is the mean over its views v of what a step of v alone would have, every view with its own render:

    L = 1/B sum_v [ (1 - lambda) L_pixel(v) + lambda (1 - SSIM(v)) + lambda_pop L_pop(opacities, dominant in v) ]

Density control sees the views of a step one after the other, in the order of the batch, as it would see those of B
steps with the same parameters: screen gradients are those of each view's own loss, a Gaussian that k views see counts k
times, `views` grows by B, dominated pixels are held against each view's own size for its blur set, and of these sets
the last, the union or the set of the sum is taken as `blur_window` says. What depends on dominated pixels of the window
(`pop_views="window"`) reads those before the step.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from pop_fast.api.backend import Backend
from pop_fast.density.control import DensityControl
from pop_fast.density.protocol import State
from pop_fast.errors import PopError
from pop_fast.stages.covariance import scales_from_log_scales
from pop_fast.stages.losses import TargetMoments, l2, photometric, target_moments
from pop_fast.stages.regularizers import mean_activation, sparse_depth_loss
from pop_fast.train.checkpoint import on_cpu, pack_optimizers
from pop_fast.train.config import TrainConfig
from pop_fast.train.evaluate import gaussians_per_pixel
from pop_fast.train.model import adam_step
from pop_fast.train.presets import LOSSES
from pop_fast.train.ranks import Ranks
from pop_fast.train.signals import Abandoned
from pop_fast.train.stepper import Task
from pop_fast.train.steps import Phase, StepStats
from pop_fast.train.views import Rendered, ViewTensors, render_view
from pop_ref.settings import Objective


@dataclass(frozen=True)
class ViewGradient:
    """A view after its backward pass: its index, render, photometric loss, regularizers or None, and their sum.

    `behind` is what its photograph was laid over if that is transparent; None where that is the settings' background.
    """

    index: int
    rendered: Rendered
    behind: Tensor | None
    objective: Tensor
    term: Tensor | None
    loss: Tensor


class PhotoLoss:
    """Compares renders with the photographs of the training views.

    What SSIM needs of a photograph alone is computed at its first visit and kept, for as many views as
    `target_cache_mb` has room for; the others compute it anew at every visit, to the same bits.
    """

    def __init__(self, config: TrainConfig, views: Sequence[ViewTensors], losses: Any) -> None:
        self._config = config
        self._views = views
        self._kept: dict[int, TargetMoments] = {}
        self._background = torch.tensor(config.background, dtype=torch.float64)
        self._room = config.target_cache_mb * 2**20
        self._losses = losses

    def __call__(self, image: Tensor, index: int, objective: Objective, background: Tensor | None = None) -> Tensor:
        """Return the loss of a render [H, W, 3] of view `index`, over another background if one is given."""
        moments, mask = self._moments(index, background), self._views[index].mask
        loss = LOSSES.named(objective.pixelwise)
        return photometric(loss, objective, image, moments.target, mask, moments, self._losses)

    def measure(
        self, image: Tensor, index: int, objective: Objective, background: Tensor | None = None
    ) -> tuple[float, float, float]:
        """Return the pixelwise loss, SSIM, and the mean square of the difference with the render clamped to [0, 1]."""
        moments, mask = self._moments(index, background), self._views[index].mask
        target = moments.target
        pixelwise = LOSSES.named(objective.pixelwise).pixelwise(image, target, mask)
        d_ssim = self._losses.d_ssim(image, target, objective.padding, mask, False, moments)
        square = l2(image.clamp(0.0, 1.0), target, mask)
        return float(pixelwise), 1.0 - float(d_ssim), float(square)

    def _moments(self, index: int, background: Tensor | None) -> TargetMoments:
        view = self._views[index]
        if background is not None and view.alpha is not None:
            # every step has another one
            return target_moments(view.target_over(background, self._background), self._config.ssim_padding)
        if index in self._kept:
            return self._kept[index]
        moments = target_moments(view.target(), self._config.ssim_padding)
        needed = sum(t.numel() * t.element_size() for t in (moments.target, moments.mu_y, moments.s_yy))
        if needed <= self._room:
            self._room -= needed
            self._kept[index] = moments
        return moments


class TorchStepper:
    """Takes steps on the CPU in the parameters' precision; see `Stepper`.

    The same parameters, statistics and number of threads give the same bits.
    """

    name = "torch"
    longest = 1

    def __init__(self, task: Task, backend: Backend) -> None:
        self.step = task.step
        self._task, self._backend = task, backend
        self._photo_loss = PhotoLoss(task.config, task.views, backend.losses())
        self._params: dict[str, Parameter] = {}
        self._optimizers: Mapping[str, Adam] = {}
        self._state: State = {}

    def synchronize(self) -> None:
        """See `Stepper.synchronize`: every process takes whole steps, so that nothing is left to take over."""

    def gather(self, everywhere: bool = False) -> None:
        """See `Stepper.gather`: every process holds all rows."""

    def rebind(self, params: dict[str, Parameter], optimizers: Mapping[str, Adam], state: State) -> None:
        self._params, self._optimizers, self._state = params, optimizers, state

    def steps(self, first: int, last: int, phase: Phase) -> list[StepStats]:
        found: list[StepStats] = []
        for step in range(first, last):
            try:
                found.append(self._take(step, phase))
            except Abandoned:
                for param in (*self._params.values(), *self._task.appearance.params.values()):
                    param.grad = None
                break
        return found

    def moments(self) -> dict[str, dict[str, Tensor]]:
        return on_cpu(pack_optimizers(self._optimizers))

    def facts(self) -> dict[str, Any]:
        return {}

    def _take(self, step: int, phase: Phase) -> StepStats:
        with self._task.stop.abandoning(self._task.may_abandon):
            look = self._look(self._task.order[step], step, phase)
            self._require_finite(look.loss.item(), look.index, step)
            stats = self._measured(look, step, phase)
        adam_step(self._params, self._optimizers, self._task.updates, step, self._state)
        self._task.appearance.update(step)
        self._task.strategy.collect(self._params, self._state, step, look.rendered.info)
        self.step = step + 1
        return stats

    def _look(self, index: int, step: int, phase: Phase) -> ViewGradient:
        """Render a view, compare it with its photograph and go back to the gradients of the parameters."""
        strategy, params, optimizers, state = self._task.strategy, self._params, self._optimizers, self._state
        rendered = self._render(index, step, phase)
        image = self._task.appearance.exposed(rendered.image, index)
        behind = self._task.appearance.behind_photo(index, step)
        objective = self._photo_loss(image, index, phase.objective, behind)
        terms = [strategy.regularizer(rendered.opacities, state, step, rendered.info), *self._terms(rendered, index)]
        found = [term for term in terms if term is not None]
        term = sum(found[1:], found[0]) if found else None
        strategy.step_pre_backward(params, optimizers, state, step, rendered.info)
        loss = objective if term is None else objective + term
        loss.backward()
        return ViewGradient(index, replace(rendered, image=image), behind, objective, term, loss)

    def _terms(self, rendered: Rendered, index: int) -> Iterator[Tensor]:
        """Give the weighted terms of the settings, whatever the strategy: depth at sparse points, opacities, scales."""
        config = self._task.config
        if rendered.depth is not None:
            samples = self._seen_from(index).depth_samples()
            assert samples is not None
            yield config.depth_lambda * self._task.scene_scale * sparse_depth_loss(rendered.depth, *samples)
        if config.opacity_reg != 0.0:
            yield config.opacity_reg * mean_activation(rendered.opacities)
        if config.scale_reg != 0.0:
            yield config.scale_reg * mean_activation(scales_from_log_scales(self._params["scales"]))

    def _seen_from(self, index: int) -> ViewTensors:
        return self._task.appearance.seen_from(self._task.views[index], index)

    def _render(self, index: int, step: int, phase: Phase) -> Rendered:
        config, strategy, appearance = self._task.config, self._task.strategy, self._task.appearance
        return render_view(
            self._backend,
            self._params,
            self._seen_from(index),
            config,
            phase.sh_degree,
            dominance=strategy.needs_dominance(step),
            counts=step % config.log_every == 0,
            absgrad=strategy.absgrad,
            background=appearance.background(step),
            depth=config.depth_lambda != 0.0 and self._task.views[index].points is not None,
        )

    def _require_finite(self, loss: float, index: int, step: int) -> None:
        if not math.isfinite(loss):
            raise ValueError(f"the loss of view {self._task.views[index].name} is {loss} at step {step}")

    def _measured(self, look: ViewGradient, step: int, phase: Phase) -> StepStats:
        """Return the loss's parts, and where a record is due everything else too."""
        photometric, pop = look.objective.item(), 0.0 if look.term is None else look.term.item()
        if step % self._task.config.log_every != 0 and not self._task.strategy.changes_after(step):
            return StepStats(math.nan, math.nan, photometric, math.nan, pop)
        image = look.rendered.image.detach()
        pixelwise, structural, square = self._photo_loss.measure(image, look.index, phase.objective, look.behind)
        return StepStats(pixelwise, structural, photometric, square, pop, *gaussians_per_pixel(look.rendered.info))


class BatchStepper(TorchStepper):
    """Takes steps of `batch_size` views; see `TorchStepper`.

    The gradients of the views are added in the order of the batch and then divided by their number, whoever drew them.
    A process holds the gradients of its own views at a time; one that trains alone holds those of one.
    """

    def _take(self, step: int, phase: Phase) -> StepStats:
        task, ranks, size = self._task, self._task.ranks, self._task.config.batch_size
        indices = task.order[step * size : (step + 1) * size]
        looks: list[dict[str, Tensor]] = []
        numbers: list[Tensor] = []
        keys: list[str] = []

        def gradients() -> Iterator[Tensor]:
            for place in ranks.positions(size):
                look = self._look(indices[place], step, phase)
                looks.append(self._seen(look, step))
                measured = (*self._measured(look, step, phase), look.loss.item())
                numbers.append(torch.tensor(measured, dtype=torch.float64))
                keys[:] = [key for key, param in self._params.items() if param.grad is not None]
                yield self._flat_gradients(keys)

        with task.stop.abandoning(task.may_abandon):
            total = ranks.total(gradients()).div_(size)
            stats = self._agreed(ranks.gather(numbers), indices, step)
        self._give_gradients(keys, total)
        adam_step(self._params, self._optimizers, task.updates, step, self._state)
        self._collect(looks, indices, step)
        self.step = step + 1
        return stats

    def _seen(self, look: ViewGradient, step: int) -> dict[str, Tensor]:
        """Take from a view what density control will read of it."""
        strategy, info = self._strategy, look.rendered.info
        if not strategy.collects(step):
            return {}
        means2d = info[strategy.key_for_gradient]
        found = {"gradient": means2d.absgrad if strategy.absgrad else means2d.grad, "radii": info["radii"]}
        if strategy.collects_blur(step) or strategy.collects_window(step):
            found["dominant_counts"] = info["dominant_counts"].long()
        return found

    def _collect(self, looks: Sequence[dict[str, Tensor]], indices: Sequence[int], step: int) -> None:
        """Let density control look at all views of the batch, one after the other."""
        gathered = {name: self._task.ranks.gather([look[name] for look in looks]) for name in looks[0]}
        if not gathered:
            return
        strategy = self._strategy
        for place, index in enumerate(indices):
            view = self._task.views[index]
            found = {name: tensors[place] for name, tensors in gathered.items()}
            gradient = found.pop("gradient")
            info: dict[str, Any] = {**found, "width": view.width, "height": view.height, "n_cameras": 1}
            info[strategy.key_for_gradient] = SimpleNamespace(grad=gradient, absgrad=gradient)
            if view.mask is not None:
                info["kept_pixels"] = view.kept_pixels
            strategy.collect(self._params, self._state, step, info)

    @property
    def _strategy(self) -> DensityControl:
        strategy = self._task.strategy
        assert isinstance(strategy, DensityControl)
        return strategy

    def _flat_gradients(self, keys: Sequence[str]) -> Tensor:
        """Take the gradients away from the parameters, as one vector."""
        found = [self._params[key].grad for key in keys]
        for param in self._params.values():
            param.grad = None
        return torch.cat([gradient.reshape(-1) for gradient in found if gradient is not None])

    def _give_gradients(self, keys: Sequence[str], total: Tensor) -> None:
        parts = total.split([self._params[key].numel() for key in keys])
        for key, part in zip(keys, parts, strict=True):
            self._params[key].grad = part.view_as(self._params[key])

    def _agreed(self, numbers: Sequence[Tensor], indices: Sequence[int], step: int) -> StepStats:
        """Return the views' mean measurements; ValueError in every process where a loss is not finite."""
        rows = [row.tolist() for row in numbers]
        for index, row in zip(indices, rows, strict=True):
            self._require_finite(row[-1], index, step)
        return StepStats(*(sum(column) / len(rows) for column in list(zip(*rows, strict=True))[:-1]))


def check_batch(config: TrainConfig, own_strategy: bool, ranks: Ranks) -> None:
    """Check that the views of a step can be shared out.

    Raises:
        PopError: they cannot; says what to change.
    """
    size = config.batch_size
    if size % ranks.size:
        raise PopError(
            f"batch_size is {size}; {ranks.size} processes share the views of a step evenly: "
            f"use --batch-size {ranks.size} or a multiple of it"
        )
    learned = [name for name in ("exposure", "refine_cameras") if getattr(config, name)]
    if size > 1 and learned:
        option = learned[0].replace("_", "-")
        raise PopError(
            f"batch_size is {size}; --{option} needs steps of one view: leave out --batch-size, or --{option}"
        )
    if size > 1 and not own_strategy:
        raise PopError(f"batch_size is {size}; it must be 1 with a third-party strategy, which uses one render a step")
