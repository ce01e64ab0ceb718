"""Adam on rows, and what training needs to know of a step: learning rates, what is moved, the harmonics' degree.

Adam, with t counting updates from 1:

    m <- m + (1 - beta1) (g - m)           v <- beta2 v + (1 - beta2) g²
    x <- x - lr / (1 - beta1^t)  m / (sqrt(v) / sqrt(1 - beta2^t) + eps)

Moments are arrays with one row a Gaussian, so that density control can carry them (`density_rows`); t belongs to the
tensor. With eps = 1e-15 a gradient that keeps its sign makes steps of about lr, however small it is: that is why a tiny
weight of the POP term moves every opacity that the photographs do not hold.

Label decided here: A21 (no learning rate changes with the L2 loss).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np

from pop_ref.density import densifies_at
from pop_ref.settings import BETAS, EPS, MAX_SH_DEGREE, LearningRates, Recipe, UpdateRules

MAX_STEPS: Final = Recipe.max_steps
SH_DEGREE_INTERVAL: Final = Recipe.sh_interval


def adam_step(
    params: Mapping[str, np.ndarray],
    grads: Mapping[str, np.ndarray],
    m: Mapping[str, np.ndarray],
    v: Mapping[str, np.ndarray],
    step: int | Mapping[str, int],
    lr: Mapping[str, float],
    betas: tuple[float, float] = BETAS,
    eps: float = EPS,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Update every row of every parameter once.

    Rows without gradient move too, by what their moments remember: the update is dense.

    Source: Kingma and Ba 2015, algorithm 1.
    Departs: nothing; eps is added outside the square root, after the bias correction, as the algorithm and torch do.

    Args:
        params: arrays by name.
        grads: gradient of the loss, shapes as `params`; a key of `params` that it lacks is passed through untouched.
        m: first moments.
        v: second moments.
        step: number of this update, from 1; by name where parameters have had different numbers of updates.
        lr: learning rate of each name.
        betas: decay of the first and second moments.
        eps: keeps the quotient finite.

    Returns:
        New parameters, new first moments, new second moments.

    Raises:
        ValueError: `step` is under 1.

    Example:
        >>> zero = {"x": np.zeros(1)}
        >>> x, m, v = adam_step({"x": np.array([1.0])}, {"x": np.array([8.0])}, zero, zero, 1, {"x": 0.25})
        >>> x["x"].round(12).tolist()
        [0.75]
    """
    numbers = dict.fromkeys(grads, step) if isinstance(step, int) else step
    if (isinstance(step, int) and step < 1) or any(number < 1 for number in numbers.values()):
        raise ValueError(f"step is {step}; Adam's updates count from 1")
    beta1, beta2 = betas
    new_params, new_m, new_v = dict(params), dict(m), dict(v)
    for name, g in grads.items():
        new_m[name] = m[name] + (1.0 - beta1) * (g - m[name])
        new_v[name] = beta2 * v[name] + (1.0 - beta2) * g * g
        t = numbers[name]
        denominator = np.sqrt(new_v[name]) / np.sqrt(1.0 - beta2**t) + eps
        new_params[name] = params[name] - lr[name] / (1.0 - beta1**t) * new_m[name] / denominator
    return new_params, new_m, new_v


def adam_steps(
    params: Mapping[str, np.ndarray],
    grads: Sequence[Mapping[str, np.ndarray]],
    lr: Mapping[str, float],
    betas: tuple[float, float] = BETAS,
    eps: float = EPS,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Take the updates 1, 2, ... from zero moments.

    A parameter that an update has no gradient of waits, as the harmonics do while degree 0 is drawn. The counter goes
    on all the same: t is the number of the update, not of the gradients that the parameter has had.

    Source: Kingma and Ba 2015, algorithm 1.
    Departs: nothing; a parameter that waits before its first gradient is one whose gradients so far were 0.

    Args:
        params: arrays by name.
        grads: of each update, gradients by name.
        lr: learning rate of each name.
        betas: decay of the first and second moments.
        eps: keeps the quotient finite.

    Returns:
        New parameters, new first moments, new second moments.

    Example:
        >>> x, m, _ = adam_steps({"x": np.array([1.0])}, [{}, {"x": np.array([8.0])}], {"x": 0.25})
        >>> m["x"].round(12).tolist(), x["x"].round(3).tolist()
        ([0.8], [0.814])
    """
    moved = dict(params)
    m, v = ({name: np.zeros_like(array) for name, array in params.items()} for _ in range(2))
    for step, given in enumerate(grads, start=1):
        moved, m, v = adam_step(moved, given, m, v, step, lr, betas, eps)
    return moved, m, v


def means_learning_rate(
    step: int,
    scene_scale: float,
    max_steps: int = MAX_STEPS,
    rates: LearningRates = Recipe.lr,
    rules: UpdateRules = Recipe.updates,
) -> float:
    """Decay the positions' learning rate log-linearly: `1.6e-4 scene_scale 0.01^(step / max_steps)`.

    Mini-Splatting goes back along this curve, from `means_rewind_iter` to `means_rewind_to`. PUP-3DGS decays until its
    rounds start; in each round the step is t = `rounds_start_iter` + 1, ..., and the length of the curve the last t.

    Source: Kerbl et al. 2023, appendix C; gsplat's exponential decay; mini-splatting and gaussian-splatting-pup.
    Departs: Inria counts from 1, one step further along the same curve; the delay in its schedule is inert.

    Args:
        step: from 0; clipped to [0, max_steps].
        scene_scale: world units.
        max_steps: length of the training.
        rates: at the start.
        rules: where the curve is left.

    Returns:
        The learning rate, world units.

    Example:
        >>> means_learning_rate(0, 2.0), round(means_learning_rate(30_000, 2.0) * 1e6, 9)
        (0.00032, 3.2)
        >>> rules = UpdateRules(means_rewind_iter=15_000, means_rewind_to=5_000)
        >>> means_learning_rate(16_000, 1.0, rules=rules) == means_learning_rate(6_000, 1.0)
        True
    """
    return rates.means * scene_scale * rates.means_decay ** _share(step, max_steps, rules)


def _share(step: int, max_steps: int, rules: UpdateRules) -> float:
    """Return how much of a decay lies behind a step."""
    start, last = rules.rounds_start_iter, max_steps
    if start > 0:
        last = start
        if step >= start:
            step, last = start + (step - start) % rules.round_steps + 1, start + rules.round_steps
    elif 0 < rules.means_rewind_iter <= step:
        step = step - rules.means_rewind_iter + rules.means_rewind_to
    return min(max(step / last, 0.0), 1.0)


def learning_rates(
    step: int,
    scene_scale: float,
    max_steps: int = MAX_STEPS,
    rates: LearningRates = Recipe.lr,
    rules: UpdateRules = Recipe.updates,
) -> dict[str, float]:
    """List every parameter's learning rate at a step; only the positions' changes, and none with the loss (A21).

    Where `rates.others_decay` is not 1, as in no published method, those of scales, quaternions and harmonics decay
    too. In a round of PUP-3DGS the others are multiplied by `round_decay` each `round_decay_every` steps.

    Source: Kerbl et al. 2023; values of gsplat's trainer; gaussian-splatting-pup.
    Departs: Inria's code since October 2024 uses 0.025 for opacities (`settings.INRIA_RATES`).

    Args:
        step: from 0.
        scene_scale: world units.
        max_steps: length of the training.
        rates: at the start.
        rules: where a rate leaves its curve.

    Returns:
        Learning rates by parameter name.

    Example:
        >>> learning_rates(0, 1.0)["opacities"]
        0.05
        >>> rules = UpdateRules(rounds_start_iter=30_000)
        >>> learning_rates(30_399, 1.0, rules=rules)["scales"] / learning_rates(0, 1.0)["scales"]
        0.95
    """
    factor = 1.0
    if 0 < rules.rounds_start_iter <= step:
        taken = (step - rules.rounds_start_iter) % rules.round_steps + 1
        factor = rules.round_decay ** (taken // rules.round_decay_every)
    found = {name: factor * rate for name, rate in rates.by_parameter().items()}
    decay = rates.others_decay ** _share(step, max_steps, rules)
    found = {name: rate if name == "opacities" else decay * rate for name, rate in found.items()}
    return {**found, "means": means_learning_rate(step, scene_scale, max_steps, rates, rules)}


def is_updated(name: str, step: int, recipe: Recipe) -> bool:
    """Tell whether Adam moves a parameter at a step.

    Source: Inria's training loop (a step that edits the Gaussians moves nothing); taming-3dgs (bands beyond the first
        move at steps 16, 32, ..., of which those that edit are left out, opacities not after 15,000).
    Departs: nothing; there is no step 0 in these codes, whose first one is 1.

    Args:
        name: of the parameter.
        step: from 0.
        recipe: its density control, `updates` and `adam_restarts` are read.

    Returns:
        Whether it is moved.

    Example:
        >>> [is_updated("shN", step, Recipe(updates=UpdateRules(sh_rest_every=2))) for step in range(4)]
        [False, False, True, False]
    """
    rules = recipe.updates
    if rules.edits_replace_update and (densifies_at(step, recipe.density) or step in recipe.adam_restarts):
        return False
    if name == "opacities" and 0 <= rules.opacities_stop_iter <= step:
        return False
    return name != "shN" or max(step, 1) % rules.sh_rest_every == 0


def update_numbers(names: Iterable[str], step: int, recipe: Recipe) -> dict[str, int]:
    """Count the updates that each parameter has had when a step has been taken, for those that it moves.

    This is the t of `adam_step`; it starts again where Adam does.

    Source: Kingma and Ba 2015, algorithm 1.
    Departs: nothing.

    Args:
        names: of parameters.
        step: from 0.
        recipe: as in `is_updated`.

    Returns:
        t from 1 by name; parameters that are not moved are not in it.

    Example:
        >>> recipe = Recipe(updates=UpdateRules(sh_rest_every=2), adam_restarts=(1,))
        >>> [update_numbers(["means", "shN"], step, recipe) for step in range(4)]
        [{'means': 1}, {'means': 2}, {'means': 1, 'shN': 1}, {'means': 2}]
    """
    first = 1 + max((restart for restart in recipe.adam_restarts if restart < step), default=-1)
    moved = [name for name in names if is_updated(name, step, recipe)]
    return {name: sum(is_updated(name, s, recipe) for s in range(first, step + 1)) for name in moved}


def sh_degree_at(step: int, interval: int = SH_DEGREE_INTERVAL, max_degree: int = MAX_SH_DEGREE, start: int = 0) -> int:
    """Raise the degree of the harmonics by one each 1000 steps: `min(step // interval, max_degree)`.

    Source: Kerbl et al. 2023, appendix; gsplat's trainer; mini-splatting (which starts to count at step 15,000).
    Departs: nothing.

    Args:
        step: from 0.
        interval: steps between two raises.
        max_degree: the last degree.
        start: step from which steps are counted; before it the degree is 0.

    Returns:
        The degree that is rendered at this step.

    Example:
        >>> [sh_degree_at(step) for step in (0, 999, 1000, 2000, 29_999)]
        [0, 0, 1, 2, 3]
        >>> sh_degree_at(15_999, start=15_000), sh_degree_at(16_000, start=15_000)
        (0, 1)
    """
    return min(max(step - start, 0) // interval, max_degree)
