"""A density strategy of torch, with gsplat's protocol, driven by a script as a training run drives it.

    regularizer -> step_pre_backward -> backward pass -> Adam -> collect -> change

A strategy that collects and changes in one call has `step_post_backward` called in the place of the last two, and the
term of a `regularizer` that it does not have is none. torch is imported when a drive is made, never when the kit is.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from pop_ref.conformance.adapter import Adapter
from pop_ref.conformance.strategy_script import Script
from pop_ref.methods import COUNTER, KEYS
from pop_ref.scripted import ScriptedView
from pop_ref.settings import BETAS, EPS

# what a strategy changed: parameters and optimizers, as they are
Population = tuple[dict[str, Any], dict[str, Any]]


@dataclass(frozen=True)
class Trainer:
    """What moves the parameters between two looks of a strategy.

    Attributes:
        optimizers: makes one for each parameter.
        move: moves the parameters after a step, given parameters, optimizers, the step and the strategy's state.
        extras: arguments of `change` besides parameters, optimizers, state and step, given the step.
    """

    optimizers: Callable[[dict[str, Any]], dict[str, Any]]
    move: Callable[[dict[str, Any], dict[str, Any], int, dict[str, Any]], None]
    extras: Callable[[int], dict[str, Any]]


def drive(strategy: Any, script: Script, rows: Any, trainer: Trainer, dtype: Any) -> list[dict[str, Any]]:
    """Take a strategy through a script.

    Args:
        strategy: follows gsplat's protocol.
        script: what it is shown.
        rows: to start from, of arrays or tensors.
        trainer: Adam, and what a change may ask for.
        dtype: of the parameters, torch's.

    Returns:
        Of every step what `pop_ref.methods.scripted_steps` returns, as tensors, and besides: whether each parameter
        is trained and of which type ("trainable", "dtypes"), whether its optimizer holds it and nothing else ("held"),
        which parameters the strategy has "moved", whether it adds noise to the centres at every step ("noisy", which
        one that has a `noise_lr` does, as gsplat's MCMC), and whether it left all counters as they were ("counted").
    """
    params, optimizers = population(rows, trainer.optimizers, dtype)
    if hasattr(strategy, "check_sanity"):
        strategy.check_sanity(params, optimizers)
    state = _first_state(strategy, script)
    return [_taken(strategy, script, trainer, params, optimizers, state, step) for step in script.steps]


def population(rows: Any, make: Callable[[dict[str, Any]], dict[str, Any]], dtype: Any) -> Population:
    """Return rows as parameters with optimizers whose moments and counters are set."""
    torch = importlib.import_module("torch")

    def tensor(value: Any) -> Any:
        return torch.as_tensor(value).detach().clone().to(dtype)

    params = {key: torch.nn.Parameter(tensor(value)) for key, value in rows.params.items()}
    optimizers = make(params)
    for key, param in params.items():
        optimizers[key].state[param] = {
            "step": torch.tensor(COUNTER),
            "exp_avg": tensor(rows.m[key]),
            "exp_avg_sq": tensor(rows.v[key]),
        }
    return params, optimizers


def _first_state(strategy: Any, script: Script) -> dict[str, Any]:
    asked = {"scene_scale": script.scene_scale, "count": script.n}
    return strategy.initialize_state(**_known(strategy.initialize_state, asked))


def _known(function: Callable[..., Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that a function takes."""
    parameters = inspect.signature(function).parameters
    takes_any = any(each.kind is each.VAR_KEYWORD for each in parameters.values())
    return {name: value for name, value in options.items() if takes_any or name in parameters}


def _taken(
    strategy: Any,
    script: Script,
    trainer: Trainer,
    params: dict[str, Any],
    optimizers: dict[str, Any],
    state: dict[str, Any],
    step: int,
) -> dict[str, Any]:
    torch = importlib.import_module("torch")
    view = script.view(step, len(params["means"]))
    info, cotangent = _rendered(script, view, params)
    term = None
    if hasattr(strategy, "regularizer"):
        term = strategy.regularizer(torch.sigmoid(params["opacities"]), state, step, info)
    strategy.step_pre_backward(params, optimizers, state, step, info)
    given = script.gradients(step, {key: tuple(params[key].shape) for key in KEYS})
    loss = (info["means2d"] * cotangent).sum()
    for key in KEYS:
        loss = loss + (params[key] * torch.as_tensor(given[key]).to(params[key])).sum()
    (loss if term is None else loss + term).backward()
    info["means2d"].absgrad = _shown(script, view, view.absolute).to(params["means"])
    trainer.move(params, optimizers, step, state)
    before, counted = ({key: value.detach().clone() for key, value in params.items()}, _counters(params, optimizers))
    with torch.random.fork_rng(devices=[]):
        _seed(step)
        done = _looked(strategy, script, trainer, (params, optimizers, state), step, info)
    same = [key for key in KEYS if len(before[key]) == len(params[key]) and torch.equal(before[key], params[key])]
    return _recorded(params, optimizers) | {
        "term": 0.0 if term is None else float(term.detach()),
        "done": done,
        "moved": [key for key in KEYS if key not in same],
        "noisy": bool(getattr(strategy, "noise_lr", 0.0)),
        "counted": counted == _counters(params, optimizers),
    }


def _seed(seed: int) -> None:
    """Seed what draws: the CPU, and CUDA where it is in use.

    `torch.manual_seed` keeps the call, with its stack, for every kind of device that is not in use; that takes longer
    than a scripted step.
    """
    torch = importlib.import_module("torch")
    torch.default_generator.manual_seed(seed)
    if torch.cuda.is_initialized():
        torch.cuda.manual_seed_all(seed)


def _looked(
    strategy: Any, script: Script, trainer: Trainer, of: tuple[Any, Any, Any], step: int, info: dict[str, Any]
) -> dict[str, int]:
    """Let the strategy collect, and change the Gaussians where that is due; return what it says that it did."""
    params, optimizers, state = of
    if not hasattr(strategy, "collect"):
        # gsplat's strategies take what they need: MCMC the rate of the means, and no word of packed rows
        more = {"packed": script.packed, "lr": optimizers["means"].param_groups[0]["lr"]}
        more = _known(strategy.step_post_backward, more)
        strategy.step_post_backward(params, optimizers, state, step, info, **more)
        return {}
    strategy.collect(params, state, step, info)
    if not strategy.changes_after(step):
        return {}
    extras = trainer.extras(step)
    if not strategy.needs_passes(step):
        # as in a run, where no strategy looks at views that does not say so
        extras["passes"] = None
    found = strategy.change(params, optimizers, state, step, **extras)
    return {f.name: int(getattr(found, f.name)) for f in fields(found) if getattr(found, f.name)}


def _shown(script: Script, view: ScriptedView, values: np.ndarray) -> Any:
    """Return what is known of each camera and Gaussian as a render tells it: all of them, or packed rows."""
    torch = importlib.import_module("torch")
    return torch.as_tensor(np.ascontiguousarray(values[view.visible] if script.packed else values))


def _rendered(script: Script, view: ScriptedView, params: Mapping[str, Any]) -> tuple[dict[str, Any], Any]:
    """Return what `rasterization` would return last, and the cotangent of its screen centres."""
    torch = importlib.import_module("torch")
    cameras, gaussians = np.nonzero(view.visible)
    cotangent = _shown(script, view, view.v_means2d).to(params["means"])
    # follows from the parameters, so that its gradient is kept where that is asked for and nowhere else
    means2d = torch.zeros_like(cotangent) + 0.0 * params["means"].sum()
    ids = {"gaussian_ids": torch.as_tensor(gaussians), "camera_ids": torch.as_tensor(cameras)}
    info: dict[str, Any] = {
        "means2d": means2d,
        "radii": _shown(script, view, view.radii).to(torch.int32),
        "dominant_counts": torch.as_tensor(view.dominant_counts),
        "width": script.width,
        "height": script.height,
        "n_cameras": script.cameras,
        **(ids if script.packed else dict.fromkeys(ids)),
    }
    if view.kept_pixels is not None:
        info["kept_pixels"] = view.kept_pixels
    return info, cotangent


def _counters(params: Mapping[str, Any], optimizers: Mapping[str, Any]) -> dict[str, float]:
    return {key: float(optimizers[key].state.get(param, {}).get("step", -1.0)) for key, param in params.items()}


def _recorded(params: Mapping[str, Any], optimizers: Mapping[str, Any]) -> dict[str, Any]:
    def moments(name: str) -> dict[str, Any]:
        found = {key: optimizers[key].state.get(param, {}).get(name) for key, param in params.items()}
        return {key: None if value is None else value.detach().clone() for key, value in found.items()}

    def held(key: str) -> bool:
        optimizer, param = optimizers[key], params[key]
        groups = [each for group in optimizer.param_groups for each in group["params"]]
        of = optimizer.state.get(param, {})
        shapes = [of[name].shape for name in ("exp_avg", "exp_avg_sq") if name in of]
        alone = len(groups) == 1 and groups[0] is param and list(optimizer.state) == [param]
        return alone and shapes == [param.shape] * 2

    return {
        "params": {key: param.detach().clone() for key, param in params.items()},
        "m": moments("exp_avg"),
        "v": moments("exp_avg_sq"),
        "counters": _counters(params, optimizers),
        "trainable": {key: bool(param.requires_grad and param.is_leaf) for key, param in params.items()},
        "dtypes": {key: str(param.dtype).removeprefix("torch.") for key, param in params.items()},
        "held": {key: held(key) for key in params},
    }


class ScriptedPasses:
    """What a strategy is told that looks at the training views, as `pop_fast.density.passes.Passes` tells it.

    Args:
        script: what it is told.
        contributions: makes the trainer's record of a pass of the fields by name.
        dtype: of the parameters, torch's.
    """

    def __init__(self, script: Script, contributions: Callable[..., Any], dtype: Any) -> None:
        self._script, self._contributions, self._dtype = script, contributions, dtype
        self._torch: Any = importlib.import_module("torch")
        self.n_views = script.n_views

    def _tensor(self, array: np.ndarray) -> Any:
        tensor = self._torch.as_tensor(array)
        return tensor.to(self._dtype) if tensor.is_floating_point() else tensor

    def _over(self, params: Mapping[str, Any], index: int, sh_degree: int, divisor: int = 1) -> Any:
        return self._script.over(index, len(params["means"]), sh_degree, divisor)

    def view(self, index: int) -> Any:
        """Return the mask and the size of a view."""
        mask = self._script.mask(index)
        kept = None if mask is None else self._torch.as_tensor(mask)
        return SimpleNamespace(mask=kept, width=self._script.width, height=self._script.height)

    def photo(self, index: int) -> Any:
        """Return the photograph of a view. uint8 [H, W, 3]"""
        return self._torch.as_tensor(self._script.photo(index))

    def contributions(self, params: Mapping[str, Any], index: int, sh_degree: int, pixel_map: Any = None) -> Any:
        """Return what every Gaussian contributes to a view; `map_sum` is of the mean of the map."""
        told = self._over(params, index, sh_degree)
        image = self._tensor(told.image)
        made: Any = pixel_map(image) if callable(pixel_map) else pixel_map
        mean = 0.0 if made is None else made.double().mean()
        of = {f.name: self._tensor(getattr(told.found, f.name)) for f in fields(told.found)}
        of["map_sum"] = (self._torch.as_tensor(told.found.map_sum) * mean).to(self._dtype)
        shown = {name: self._tensor(getattr(told, name)) for name in ("dominant_counts", "radii", "depths")}
        return self._contributions(**of, **shown, image=image)

    def sensitivities(self, params: Mapping[str, Any], index: int, sh_degree: int) -> Any:
        """Return Speedy-Splat's scores of a view. [N] float64"""
        return self._torch.as_tensor(self._over(params, index, sh_degree).sensitivities)

    def fisher(self, params: Mapping[str, Any], index: int, sh_degree: int, divisor: int = 4) -> Any:
        """Return PUP-3DGS's blocks of a view. [N, 6, 6] float64"""
        return self._torch.as_tensor(self._over(params, index, sh_degree, divisor).blocks)

    def dominant_points(self, params: Mapping[str, Any], index: int, sh_degree: int) -> tuple[Any, Any, Any]:
        """Return the point of every pixel, the Gaussian that it belongs to, and the remaining transmittance."""
        told = self._over(params, index, sh_degree)
        return self._tensor(told.points), self._torch.as_tensor(told.ids), self._tensor(told.T_final)


class StrategyAdapter(Adapter):
    """Somebody's strategy under judgement by the laws that are not about a method.

    Args:
        name: how reports call it.
        make: makes the strategy of settings by name, those that it knows.
        dtype: "float32" or "float64".
    """

    def __init__(self, name: str, make: Callable[..., Any], dtype: str = "float32") -> None:
        self.name, self._make = name, make
        self.dtype = {"float64": np.float64, "float32": np.float32}[dtype]
        self._torch: Any = importlib.import_module("torch")
        self._float = getattr(self._torch, dtype)

    def optimizers(self) -> None:
        """Offer to be asked which parameters the optimizers hold."""

    def scripted_steps(self, script: Script, rows: Any) -> list[dict[str, Any]]:
        """Take the strategy through a script from these rows, with torch's own Adam."""
        strategy = self._make(**_known(self._make, script.settings))

        def optimizers(params: dict[str, Any]) -> dict[str, Any]:
            rates = script.lr.by_parameter()
            return {
                key: self._torch.optim.Adam([param], lr=rates[key], betas=BETAS, eps=EPS)
                for key, param in params.items()
            }

        def move(params: dict[str, Any], made: dict[str, Any], step: int, state: dict[str, Any]) -> None:
            for optimizer in made.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)

        found = drive(strategy, script, rows, Trainer(optimizers, move, lambda step: {}), self._float)
        return arrays_of(found)


def arrays_of(value: Any) -> Any:
    """Return a value with its tensors as arrays of float64 or int64."""
    if isinstance(value, Mapping):
        return {key: arrays_of(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [arrays_of(each) for each in value]
    if is_dataclass(value) or not hasattr(value, "detach"):
        return value
    array = value.detach().cpu().numpy()
    return array.astype({"f": np.float64, "i": np.int64}.get(array.dtype.kind, array.dtype))
