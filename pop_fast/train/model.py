"""The raw parameters that are trained, each with its own Adam, and one step of all of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam, Optimizer

from pop_fast.activations import scales_from_log_scales
from pop_fast.train.schedule import means_lr
from pop_ref.settings import BETAS, EPS, LearningRates

KEYS: Final = ("means", "scales", "quats", "opacities", "sh0", "shN")


class _Moments(Adam):
    """Adam, made without importing torch's compiler.

    torch keeps its compiler out of `add_param_group`, which every optimizer calls when it is made, and imports it for
    that: 0.6 s before a first step that compiles nothing. An engine other than torch's never calls what else does so.
    """

    add_param_group = getattr(Optimizer.add_param_group, "__wrapped__", Optimizer.add_param_group)


def learning_rates(lr: LearningRates, scene_scale: float) -> dict[str, float]:
    """Return the learning rate of each parameter, the means' at step 0 and in world units.

    Args:
        lr: the settings.
        scene_scale: the unit of the means' rate, world units.
    """
    return {**lr.by_parameter(), "means": lr.means * scene_scale}


def make_optimizers(params: Mapping[str, Parameter], lr: LearningRates, scene_scale: float) -> dict[str, Adam]:
    """Make one dense Adam a parameter, its moments zero, the counter of steps on the CPU.

    Args:
        params: raw parameters by name.
        lr: the settings.
        scene_scale: the unit of the means' learning rate, world units.
    """
    rates = learning_rates(lr, scene_scale)
    made: dict[str, Adam] = {
        key: _Moments([param], lr=rates[key], betas=BETAS, eps=EPS, fused=True) for key, param in params.items()
    }
    for key, optimizer in made.items():
        moments = {name: torch.zeros_like(params[key].detach()) for name in ("exp_avg", "exp_avg_sq")}
        optimizer.state[params[key]] = {"step": torch.zeros((), dtype=torch.float32), **moments}
    return made


def adam_step(
    params: Mapping[str, Parameter],
    optimizers: Mapping[str, Adam],
    lr: LearningRates,
    scene_scale: float,
    step: int,
    max_steps: int,
    sh_degree: int,
) -> None:
    """Move every parameter along its gradient, and forget the gradients; see `pop_ref.optimizer.adam_steps`.

    Args:
        params: raw parameters with gradients.
        optimizers: one per key.
        lr: the rates; that of the means decays over `max_steps`.
        scene_scale: the unit of the means' rate, world units.
        step: counts from 0.
        max_steps: length of the schedule.
        sh_degree: highest colour band that was drawn; at 0 the harmonics beyond it wait, with their counter going on.
    """
    optimizers["means"].param_groups[0]["lr"] = means_lr(step, max_steps, lr.means * scene_scale, lr.means_decay)
    for key, optimizer in optimizers.items():
        if key == "shN" and sh_degree == 0:
            advance_idle(optimizer, params[key])
        else:
            optimizer.step()
        optimizer.zero_grad(set_to_none=True)


def advance_idle(optimizer: Adam, param: Tensor) -> None:
    """Advance Adam's step counter as a step with a zero gradient and zero moments would, which changes nothing else.

    With g = m = v = 0 the update is `lr * 0 / (0 + eps) = 0` and m and v stay 0; the counter has to go on because the
    bias corrections `1 - beta^step` read it.
    """
    optimizer.state[param]["step"] += 1


def first_non_finite(tensors: Mapping[str, Tensor]) -> tuple[str, list[int], float] | None:
    """Return the name, the index and the value of the first entry that is NaN or infinite, or None."""
    for name, tensor in tensors.items():
        # the sum is finite unless an entry is not (or it overflows): one pass that needs no mask
        if torch.isfinite(tensor.sum()):
            continue
        bad = torch.nonzero(~torch.isfinite(tensor))
        if len(bad):
            index = [int(i) for i in bad[0]]
            return name, index, float(tensor[tuple(index)])
    return None


def first_unusable(params: Mapping[str, Tensor]) -> tuple[str, list[int], float] | None:
    """Return name, index and value of the first raw parameter that cannot be rendered, or None.

    That is one which is not finite, or a scale whose exponential is not.
    """
    return first_non_finite(params) or first_non_finite({"scales": scales_from_log_scales(params["scales"])})
