"""The raw parameters that are trained, each with its own Adam, and one step of all of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam, Optimizer

from pop_fast.density.protocol import State
from pop_fast.errors import PopError
from pop_fast.stages.covariance import scales_from_log_scales
from pop_fast.train.steps import Updates
from pop_ref.settings import BETAS, EPS, PARAMETERS

KEYS: Final = PARAMETERS
MOMENTS: Final = ("exp_avg", "exp_avg_sq")  # of Adam, by torch's names


class _Moments(Adam):
    """Adam, made without importing torch's compiler.

    torch keeps its compiler out of `add_param_group`, which every optimizer calls when it is made, and imports it for
    that: 0.6 s before a first step that compiles nothing. An engine other than torch's never calls what else does so.
    """

    add_param_group = getattr(Optimizer.add_param_group, "__wrapped__", Optimizer.add_param_group)


def make_optimizers(
    params: Mapping[str, Parameter], packed: Mapping[str, Mapping[str, Tensor]] | None = None
) -> dict[str, Adam]:
    """Make one dense Adam a parameter, the counter of updates on the CPU.

    `adam_step` sets its rate and the decay of its moments.

    Args:
        packed: moments and counters by parameter, as `pop_fast.train.checkpoint.pack_optimizers` gives them; without
            them there were no updates.
    """
    made: dict[str, Adam] = {
        key: _Moments([param], lr=0.0, betas=BETAS, eps=EPS, fused=True) for key, param in params.items()
    }
    for key, optimizer in made.items():
        if packed is not None:
            optimizer.state[params[key]] = dict(packed[key])
            continue
        moments = {name: torch.zeros_like(params[key].detach()) for name in MOMENTS}
        optimizer.state[params[key]] = {"step": torch.zeros((), dtype=torch.float32), **moments}
    return made


def adam_step(
    params: Mapping[str, Parameter], optimizers: Mapping[str, Adam], updates: Updates, step: int, state: State
) -> None:
    """Move every parameter whose turn it is by its gradient, and forget the gradients; see `pop_ref.training.update`.

    A parameter without a gradient, as the bands beyond the first are while band 0 alone is drawn, waits: with zero
    moments Adam would not move it.

    Args:
        state: holds the gradients that wait for an update, under "sh_rest_sum".
    """
    rates, numbers = updates.rates[step].tolist(), updates.numbers[step].tolist()
    for key, rate, number in zip(PARAMETERS, rates, numbers, strict=True):
        if key not in params:
            continue
        param, optimizer = params[key], optimizers[key]
        if key == "shN" and updates.sh_rest_every > 1:
            _wait(param, state, number > 0)
        if number > 0:
            counter = optimizer.state[param]["step"]
            counter.fill_(float(number - 1))
            optimizer.param_groups[0].update(lr=rate, betas=updates.betas)
            optimizer.step()
            counter.fill_(float(number))
        optimizer.zero_grad(set_to_none=True)


def _wait(param: Parameter, state: State, due: bool) -> None:
    """Let the gradient join those that wait or, with an update due, be their sum."""
    waiting = state.get("sh_rest_sum")
    found = waiting if param.grad is None else param.grad if waiting is None else waiting + param.grad
    param.grad, state["sh_rest_sum"] = (found, None) if due else (None, found)


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


def require_usable(params: Mapping[str, Tensor], when: str) -> None:
    """Raise PopError, which names the first number and says what to do, where raw parameters cannot be rendered."""
    if found := first_unusable(params):
        name, index, value = found
        raise PopError(
            f"{name}{index} is {value} {when}: lower the learning rate of {name} and start again, "
            "or check the photographs and masks of the capture"
        )
