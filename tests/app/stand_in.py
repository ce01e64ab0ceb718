"""A stand-in for the GPU's fused step: the same interface, on the CPU, made of the CPU trainer's own stages.

It is told no more than the fused step is, StepSettings and Phases, so that a run through it shows that these carry the
whole meaning of the settings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from cuda_ext.train_settings import Phase, Statistics, StepSettings, StepValues
from pop_fast.activations import opacities_from_logits, scales_from_log_scales
from pop_fast.backends import get_backend
from pop_fast.losses import l1, l2, photometric_3dgs, photometric_pop, ssim
from pop_fast.polarization import importance_mask, pop_loss
from pop_fast.rasterization import rasterization
from pop_fast.train.hardware import Hardware
from pop_fast.train.schedule import means_lr
from pop_fast.train.views import ViewTensors

Rows = Mapping[str, Tensor]
# of tests/app/tiny.py: the CPU trainer counts Gaussians per pixel where it logs, over lists that round otherwise
LOG_EVERY = 2


class StandIn:
    """See `cuda_ext.train_step.FusedTrainer`; tests may set `before_step`, which is called with the step's number."""

    def __init__(
        self,
        params: Rows,
        m: Rows,
        v: Rows,
        views: Sequence[ViewTensors],
        order: Sequence[int],
        settings: StepSettings,
        step: int,
    ) -> None:
        assert len(order) >= settings.max_steps
        self.views, self.order, self.settings, self.step = views, order, settings, step
        self.grown = 0
        self.runs: list[tuple[int, int, Phase]] = []
        self._told: dict[int, StepValues] = {}
        self.rebind(params, m, v)

    def rebind(self, params: Rows, m: Rows, v: Rows) -> None:
        self.params, self.m, self.v = dict(params), dict(m), dict(v)
        self.statistics = Statistics.zeros(len(params["means"]), params["means"].device)

    def run(self, until: int, phase: Phase) -> None:
        self.runs.append((self.step, until, phase))
        while self.step < until:
            self.before_step(self.step)
            for rows in self.params.values():
                bad = torch.nonzero(~torch.isfinite(rows.flatten(1) if rows.dim() > 1 else rows[:, None]))
                if len(bad):
                    raise ValueError(f"step {self.step}: Gaussian {int(bad[0, 0])} has a value that is not finite")
            self._told[self.step] = self._one(self.views[self.order[self.step]], phase)
            self.step += 1

    def told(self, first: int, last: int) -> list[StepValues]:
        return [self._told[step] for step in range(first, last)]

    def before_step(self, step: int) -> None:
        """Nothing; for tests."""

    def _one(self, view: ViewTensors, phase: Phase) -> StepValues:
        s = self.settings
        leaves = {name: Parameter(rows) for name, rows in self.params.items()}
        opacities = opacities_from_logits(leaves["opacities"])
        image, info = self._drawn(leaves, opacities, view, phase)
        target, mask, weight = view.target(), view.mask, phase.lambda_ssim
        objective = photometric_3dgs if phase.l1 else photometric_pop
        photometric = objective(image, target, weight, s.padding, mask, s.d_ssim_halved, s.pixelwise_scale)
        counts = self._counts(info, view) if phase.tells else None
        loss, pop = photometric, 0.0
        if phase.pop:
            assert counts is not None
            before = self.statistics.dominant_sum if s.pop_views == "window" else 0
            visible = (info["radii"][0] > 0).all(-1) if s.pop_over == "visible" else None
            term = s.lambda_pop * pop_loss(opacities, importance_mask(counts + before), visible)
            loss, pop = photometric + term, float(term.detach())
        info["means2d"].retain_grad()
        loss.backward()
        self._update(leaves, phase)
        self._collect(info, view, phase, counts)
        image = image.detach()
        squares = l2(image.clamp(0.0, 1.0), target, mask)
        pixelwise = (l1 if phase.l1 else l2)(image, target, mask)
        values = (pixelwise, ssim(image, target, s.padding, mask), photometric.detach(), squares)
        return StepValues(*(float(value) for value in values), pop)

    def _drawn(self, leaves: Mapping[str, Tensor], opacities: Tensor, view: ViewTensors, phase: Phase) -> Any:
        s, bands = self.settings, (phase.sh_degree + 1) ** 2
        sh = leaves["sh0"] if bands == 1 else torch.cat([leaves["sh0"], leaves["shN"][:, : bands - 1]], dim=1)
        colors, _, info = rasterization(
            leaves["means"], leaves["quats"], scales_from_log_scales(leaves["scales"]), opacities, sh,
            view.viewmat, view.K, view.width, view.height, sh_degree=phase.sh_degree, packed=False,
            backgrounds=torch.tensor([s.background]) if any(s.background) else None, profile=s.profile,
            rasterize_mode="antialiased" if s.antialiased else "classic", dominance=phase.tells,
            counts=self.step % LOG_EVERY == 0,
        )  # fmt: skip
        return colors[0], info

    def _counts(self, info: Mapping[str, Tensor], view: ViewTensors) -> Tensor:
        if view.mask is None:
            return info["dominant_counts"][0]
        ids = info["dominant_ids"][0][view.mask]
        return torch.bincount(ids[ids >= 0], minlength=len(self.params["means"]))

    def _update(self, leaves: Mapping[str, Parameter], phase: Phase) -> None:
        s = self.settings
        for name, leaf in leaves.items():
            if name == "shN" and phase.sh_degree == 0:
                continue
            rate = means_lr(self.step, s.max_steps, s.lr[name], s.means_decay) if name == "means" else s.lr[name]
            optimizer = Adam([leaf], lr=rate, betas=s.betas, eps=s.eps, fused=True)
            moments = {"exp_avg": self.m[name], "exp_avg_sq": self.v[name]}
            optimizer.state[leaf] = {"step": torch.tensor(float(self.step)), **moments}
            optimizer.step()

    def _collect(self, info: Mapping[str, Any], view: ViewTensors, phase: Phase, counts: Tensor | None) -> None:
        found = self.statistics
        if phase.statistics:
            grads = info["means2d"].grad
            unit = grads.new_tensor([0.5 * view.width, 0.5 * view.height])
            visible = (info["radii"] > 0).all(-1)
            norms = torch.linalg.vector_norm(grads * unit, dim=-1)
            found.grad_sum.add_(norms.masked_fill_(~visible, 0.0).sum(0))
            found.n_visible.add_(visible.sum(0))
        if phase.blur or phase.window:
            assert counts is not None
            found.dominant_sum.add_(counts.int())
        if phase.blur:
            blurred = counts > self.settings.blur_pixels(view.kept_pixels)
            found.blurred.copy_(blurred if self.settings.blur_window == "own_view" else found.blurred.bool() | blurred)


def stand_in_hardware() -> Hardware:
    """Return hardware that is the CPU: a run on it must be the CPU trainer's run."""
    facts = {"gpu": "stand-in", "gpu_memory_bytes": 0}
    return Hardware(torch.device("cpu"), get_backend("fast"), StandIn, lambda: facts)
