"""Density control and Adam of a torch trainer as stage functions: what its strategy, its row operations and its
optimizers do when it trains, under the oracle's names.

Gaussians are taken into the trainer's own form, parameters with one optimizer each whose moments are set, and back.
torch and the trainer are imported when the stages are made, never when the kit is.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from types import SimpleNamespace
from typing import Any

from pop_ref.conformance import torch_strategy
from pop_ref.conformance.strategy_script import Script
from pop_ref.conformance.torch_strategy import ScriptedPasses, arrays_of
from pop_ref.density import DensityConfig
from pop_ref.settings import AppearanceRates, LearningRates, Recipe, UpdateRules

# `pop_ref.optimizer.adam_step` on tensors
Adam = Callable[..., tuple[dict[str, Any], dict[str, Any], dict[str, Any]]]
# at this step nothing but statistics happens
QUIET_STEP = 1


@dataclass(frozen=True)
class Rows:
    """`pop_ref.density_rows.Rows` of tensors."""

    params: Mapping[str, Any]
    m: Mapping[str, Any]
    v: Mapping[str, Any]


@dataclass(frozen=True)
class Statistics:
    """`pop_ref.density.Statistics` of tensors."""

    grad_sum: Any
    n_visible: Any
    n_views: int
    dominant_sum: Any
    blurred: Any


def training_stages(package: str, adam: Adam | None = None) -> dict[str, Callable[..., Any]]:
    """Return the stage functions, on tensors, of a trainer laid out as `pop_fast` is.

    Args:
        package: the trainer's.
        adam: of an engine, which then moves the rows that strategies edit; None takes the optimizers' own.
    """
    trainer, density = Trainer(package, adam), importlib.import_module(f"{package}.stages.density")
    # what a strategy decides by is a function already; everything else is what it does
    decided = ("average_grads", "grow_masks", "prune_mask")
    done = [name for name in vars(Trainer) if not name.startswith("_")]
    return {name: getattr(density, name) for name in decided} | {name: getattr(trainer, name) for name in done}


class Trainer:
    """A trainer with `density` and `density.rows`, and with `appearance`, `config`, `model` and `schedule` in `train`.

    Every method has the name, the parameters and the meaning of a function of the oracle, on tensors.
    """

    def __init__(self, package: str, adam: Adam | None = None) -> None:
        self._adam = adam
        self._torch: Any = importlib.import_module("torch")
        self._ops: Any = importlib.import_module(f"{package}.density.rows")
        self._model: Any = importlib.import_module(f"{package}.train.model")
        self._schedule: Any = importlib.import_module(f"{package}.train.schedule")
        self._config: Any = importlib.import_module(f"{package}.train.config")
        self._presets: Any = importlib.import_module(f"{package}.train.presets")
        self._appearance: Any = importlib.import_module(f"{package}.train.appearance")
        self._passes: Any = importlib.import_module(f"{package}.density.passes")
        self._Draws: Any = importlib.import_module(f"{package}.density.protocol").Draws
        self._Strategy: Any = importlib.import_module(f"{package}.density").POPStrategy

    def rows_from_params(self, params: Mapping[str, Any]) -> Rows:
        """See `pop_ref.density_rows.rows_from_params`."""
        return self._rows(*self._population(params))

    def clone_rows(self, rows: Rows, mask: Any) -> Rows:
        """See `pop_ref.density_rows.clone_rows`."""
        return self._edited(rows, self._ops.clone, mask)

    def split_rows(self, rows: Rows, mask: Any, normals: Any, revised_opacity: bool = False) -> Rows:
        """See `pop_ref.density_rows.split_rows`."""
        return self._edited(rows, self._ops.split, mask, normals, revised_opacity)

    def prune_rows(self, rows: Rows, mask: Any) -> Rows:
        """See `pop_ref.density_rows.prune_rows`."""
        return self._edited(rows, self._ops.prune, mask)

    def reset_opacities(self, rows: Rows, ceiling: float = 0.01) -> Rows:
        """See `pop_ref.density_rows.reset_opacities`."""
        params, optimizers = self._population(rows.params, rows)
        self._ops.reset_opacities(params, optimizers, ceiling)
        return self._rows(params, optimizers)

    def blur_set(
        self,
        dominant_counts: Any,
        width: int,
        height: int,
        theta_blur: float,
        min_pixels: float = 0.0,
        kept_pixels: int | None = None,
    ) -> Any:
        """See `pop_ref.density.blur_set`."""
        n, nothing = len(dominant_counts), self._torch.zeros((len(dominant_counts), 2))
        config = DensityConfig(theta_blur=theta_blur, blur_min_pixels=min_pixels, blur_window="own_view")
        empty = Statistics(nothing[:, 0], nothing[:, 0], 0, dominant_counts, nothing[:, 0] > 0)
        unseen = self._torch.zeros(n, dtype=self._torch.bool)
        return self.accumulate(empty, nothing, unseen, dominant_counts, width, height, config, kept_pixels).blurred

    def accumulate(
        self,
        statistics: Statistics,
        v_means2d: Any,
        visible: Any,
        dominant_counts: Any,
        width: int,
        height: int,
        config: DensityConfig,
        kept_pixels: int | None = None,
    ) -> Statistics:
        """See `pop_ref.density.accumulate`."""
        strategy = self._strategy(config)
        # a window that has seen nothing is as the strategy makes it
        seen = statistics.n_views > 0
        state = self._state(strategy, statistics, 1.0) if seen else strategy.initialize_state(1.0)
        means2d = self._torch.zeros_like(v_means2d)[None].requires_grad_()
        means2d.grad = v_means2d[None]
        info = {
            "means2d": means2d,
            "radii": visible[None, :, None].expand(-1, -1, 2).int(),
            "dominant_counts": dominant_counts[None],
            "n_cameras": 1,
            "width": width,
            "height": height,
        }
        if kept_pixels is not None:
            info["kept_pixels"] = kept_pixels
        params = {"means": self._torch.zeros_like(v_means2d)}
        strategy.step_post_backward(params, {}, state, QUIET_STEP, info)
        return self._statistics(state, statistics.grad_sum)

    def densifies_at(self, step: int, config: DensityConfig) -> bool:
        """See `pop_ref.density.densifies_at`."""
        return bool(self._strategy(config).is_refine_step(step))

    def resets_at(self, step: int, config: DensityConfig) -> bool:
        """See `pop_ref.density.resets_at`."""
        return bool(self._strategy(config).is_reset_step(step))

    def densify_and_prune(
        self,
        rows: Rows,
        statistics: Statistics,
        scene_scale: float,
        step: int,
        normals: Callable[[int], Any],
        config: DensityConfig,
    ) -> tuple[Rows, Statistics]:
        """See `pop_ref.density.densify_and_prune`."""
        strategy = self._strategy(config)
        params, optimizers = self._population(rows.params, rows)
        state = self._state(strategy, statistics, scene_scale)
        strategy.change(params, optimizers, state, step, self._Draws(normals, None))
        return self._rows(params, optimizers), self._statistics(state, statistics.grad_sum)

    def adam_step(
        self,
        params: Mapping[str, Any],
        grads: Mapping[str, Any],
        m: Mapping[str, Any],
        v: Mapping[str, Any],
        step: int,
        lr: Mapping[str, float],
    ) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
        """See `pop_ref.optimizer.adam_step`; the trainer chooses betas and eps."""
        leaves, optimizers = self._population(params, Rows(params, m, v))
        self._move(leaves, optimizers, grads, lr, step)
        moved = self._rows(leaves, optimizers)
        return dict(moved.params), dict(moved.m), dict(moved.v)

    def adam_steps(
        self, params: Mapping[str, Any], grads: Sequence[Mapping[str, Any]], lr: Mapping[str, float]
    ) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
        """See `pop_ref.optimizer.adam_steps`; only the harmonics beyond the first band can wait."""
        leaves, optimizers = self._population(params)
        for step, given in enumerate(grads, start=1):
            self._move(leaves, optimizers, given, lr, step)
        moved = self._rows(leaves, optimizers)
        return dict(moved.params), dict(moved.m), dict(moved.v)

    def learning_rates(
        self,
        step: int,
        scene_scale: float,
        max_steps: int | None = None,
        rates: LearningRates | None = None,
        rules: UpdateRules | None = None,
    ) -> dict[str, float]:
        """See `pop_ref.optimizer.learning_rates`; what is left out is the trainer's own."""
        config = self._config.TrainConfig()
        given = (rates or config.lr, scene_scale, max_steps or config.max_steps, rules)
        found = self._schedule.updates_of(*given).rates[step].tolist()
        return dict(zip(self._model.KEYS, found, strict=True))

    def update_numbers(self, names: Sequence[str], step: int, recipe: Recipe) -> dict[str, int]:
        """See `pop_ref.optimizer.update_numbers`."""
        strategy = self._strategy(recipe.density)
        edits = [each for each in range(recipe.max_steps) if strategy.is_refine_step(each)]
        given = (recipe.lr, 1.0, recipe.max_steps, recipe.updates, edits, recipe.adam_restarts)
        found = self._schedule.updates_of(*given).numbers[step].tolist()
        named = dict(zip(self._model.KEYS, found, strict=True))
        return {name: named[name] for name in names if named[name] > 0}

    def means_learning_rate(self, step: int, scene_scale: float) -> float:
        """See `pop_ref.optimizer.means_learning_rate`."""
        return self.learning_rates(step, scene_scale)["means"]

    def appearance_steps(
        self,
        grads: Sequence[Mapping[str, Any]],
        viewmats: Any,
        max_steps: int | None = None,
        rates: AppearanceRates | None = None,
    ) -> dict[str, Any]:
        """See `pop_ref.appearance.appearance_steps`; what is left out is the trainer's own.

        After every step the run goes on from what it has saved.
        """
        config = self._config.TrainConfig()
        learned = grads[0] if grads else ()
        chosen = {"exposure": "exposures" in learned, "refine_cameras": "cameras" in learned}
        given = {"max_steps": max_steps or config.max_steps, "appearance_lr": rates or config.appearance_lr}
        views = [SimpleNamespace(viewmat=viewmat[None]) for viewmat in viewmats]
        config = replace(config, **chosen, **given)
        appearance = self._appearance.Appearance(config, views)
        for step, grad in enumerate(grads):
            for name, param in appearance.params.items():
                param.grad = grad[name].to(param.dtype)
            appearance.update(step)
            saved, appearance = appearance.state_dict(), self._appearance.Appearance(config, views)
            appearance.load_state_dict(saved)
        return {name: param.detach() for name, param in appearance.params.items()}

    def sh_degree_at(
        self, step: int, interval: int | None = None, max_degree: int | None = None, start: int = 0
    ) -> int:
        """See `pop_ref.optimizer.sh_degree_at`; what is left out is the trainer's own."""
        config = self._config.TrainConfig()
        degree = config.sh_degree if max_degree is None else max_degree
        return int(self._schedule.active_sh_degree(step, interval or config.sh_interval, degree, start))

    def optimizers(self) -> None:
        """Offer to be asked which parameters the optimizers hold."""

    def method_settings(self, method: str) -> dict[str, Any]:
        """Return every setting of the strategy that a run of the method has."""
        strategy = self._config.TrainConfig.of(method=method).strategy
        return {f.name: getattr(strategy, f.name) for f in fields(strategy)}

    def scripted_steps(self, script: Script, rows: Rows) -> list[dict[str, Any]]:
        """Take one of the trainer's methods through a script from these rows; see `torch_strategy.drive`."""
        strategy = self._presets.METHODS[script.method or "pop"].strategy(**script.settings)
        schedule = SimpleNamespace(lr=script.lr, max_steps=script.max_steps)
        updates = self._schedule.updates_of_strategy(schedule, strategy, script.scene_scale)
        dtype = rows.params["means"].dtype
        passes, drawn = ScriptedPasses(script, self._passes.ViewContributions, dtype), script.draws()
        draws = self._Draws(
            lambda n: self._torch.as_tensor(drawn.normals(n)), lambda n: self._torch.as_tensor(drawn.uniforms(n))
        )

        def extras(step: int) -> dict[str, Any]:
            return {"draws": draws, "passes": passes, "sh_degree": script.sh_degree(step)}

        def move(params: Any, optimizers: Any, step: int, state: Any) -> None:
            self._model.adam_step(params, optimizers, updates, step, state)

        trainer = torch_strategy.Trainer(self._optimizers, move, extras)
        return arrays_of(torch_strategy.drive(strategy, script, rows, trainer, dtype))

    def _optimizers(self, params: dict[str, Any]) -> dict[str, Any]:
        """Make the trainer's optimizers; where an engine has an Adam of its own, that is what their step calls."""
        made: dict[str, Any] = self._model.make_optimizers(params)
        if self._adam is not None:
            for optimizer in made.values():
                optimizer.step = functools.partial(_step_by, self._adam, optimizer)
        return made

    def _move(self, leaves: Any, optimizers: Any, grads: Mapping[str, Any], lr: Mapping[str, float], step: int) -> None:
        for key, grad in grads.items():
            leaves[key].grad = grad.clone()
        rates = {key: lr.get(key, 0.0) for key in self._model.KEYS}
        self._model.adam_step(leaves, optimizers, self._schedule.steady_updates(rates, step), step - 1, {})

    def _population(
        self,
        params: Mapping[str, Any],
        moments: Rows | None = None,
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return leaves and the trainer's optimizers of them, with these moments or as they are made."""
        if moments is not None:
            return torch_strategy.population(moments, self._model.make_optimizers, moments.m["means"].dtype)
        leaves = {key: self._torch.nn.Parameter(value.clone()) for key, value in params.items()}
        return leaves, self._model.make_optimizers(leaves)

    def _rows(self, leaves: Mapping[str, Any], optimizers: Mapping[str, Any]) -> Rows:
        """Return parameters and moments."""

        def moments(name: str) -> dict[str, Any]:
            return {key: optimizers[key].state[leaf][name].detach() for key, leaf in leaves.items()}

        params = {key: leaf.detach() for key, leaf in leaves.items()}
        return Rows(params, moments("exp_avg"), moments("exp_avg_sq"))

    def _edited(self, rows: Rows, operation: Callable[..., None], *args: Any) -> Rows:
        params, optimizers = self._population(rows.params, rows)
        operation(params, optimizers, {}, *args)
        return self._rows(params, optimizers)

    def _strategy(self, config: DensityConfig) -> Any:
        """Return the trainer's strategy under these settings, without a prior: there is no loss to add it to."""
        names = {f.name for f in fields(self._Strategy)}
        shared = {name: getattr(config, name) for name in names & {f.name for f in fields(DensityConfig)}}
        return self._Strategy(**shared, **({"lambda_pop": 0.0} if "lambda_pop" in names else {}))

    def _state(self, strategy: Any, statistics: Statistics, scene_scale: float) -> dict[str, Any]:
        """Return the strategy's state with these statistics."""
        return {
            **strategy.initialize_state(scene_scale),
            "grad2d": statistics.grad_sum.clone(),
            "count": statistics.n_visible.to(statistics.grad_sum.dtype),
            "views": statistics.n_views,
            "blurred": statistics.blurred.clone(),
            "dominant_sum": statistics.dominant_sum.clone(),
        }

    def _statistics(self, state: Mapping[str, Any], like: Any) -> Statistics:
        none = self._torch.zeros_like(state["grad2d"])
        blurred, won = state["blurred"], state["dominant_sum"]
        return Statistics(
            grad_sum=state["grad2d"].to(like.dtype),
            n_visible=state["count"].long(),
            n_views=state["views"],
            dominant_sum=none.long() if won is None else won,
            blurred=none.bool() if blurred is None else blurred,
        )


def _step_by(adam: Adam, optimizer: Any) -> None:
    """Move the parameter of a torch optimizer, and the moments that it holds, by an engine's Adam."""
    group = optimizer.param_groups[0]
    (param,) = group["params"]
    if param.grad is None:
        return
    of = optimizer.state[param]
    given = (param.detach(), param.grad, of["exp_avg"], of["exp_avg_sq"])
    when = (int(of["step"]) + 1, {"means": group["lr"]}, group["betas"])
    moved = adam(*({"means": value} for value in given), *when)
    for held, value in zip((param.data, of["exp_avg"], of["exp_avg_sq"]), moved, strict=True):
        held.copy_(value["means"])
