"""A training run in the oracle's terms: settings from a recipe, rows and statistics as the oracle's state."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np

from pop_fast.density import POPStrategy
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.presets import values_of
from pop_ref.density import Rows, Statistics, zero_statistics
from pop_ref.settings import DensityConfig, PopTerm, Recipe, UpdateRules
from pop_ref.training import Training

KEYS = ("means", "scales", "quats", "opacities", "sh0", "shN")


def config_of(recipe: Recipe, folder: Any, **changes: Any) -> TrainConfig:
    """Return the settings of a run that does what a recipe says, over views that are all trained on."""
    density = {f.name: getattr(recipe.density, f.name) for f in fields(DensityConfig)}
    term = {f.name: getattr(recipe, f.name) for f in fields(PopTerm)}
    rules = {f.name: getattr(recipe.updates, f.name) for f in fields(UpdateRules)}
    settings: dict[str, Any] = {
        "result_dir": str(folder),
        **values_of(recipe),
        "strategy": POPStrategy(**density, **term, **rules),
        "test_every": 0,
        "threads": 1,
        "progress": False,
        **changes,
    }
    return TrainConfig(**settings)


def state_of(run: TrainingRun) -> Training:
    """Take a run's rows and statistics as the oracle's."""
    arrays = {key: _array(run.params[key]) for key in KEYS}
    moments = {key: run.optimizers[key].state[run.params[key]] for key in KEYS}
    m, v = ({key: _array(moments[key][name]) for key in KEYS} for name in ("exp_avg", "exp_avg_sq"))
    found, empty = run.state, zero_statistics(len(arrays["means"]))

    def taken(name: str, otherwise: np.ndarray) -> np.ndarray:
        return otherwise if found[name] is None else _array(found[name]).astype(otherwise.dtype)

    statistics = Statistics(
        grad_sum=taken("grad2d", empty.grad_sum),
        n_visible=taken("count", empty.n_visible),
        n_views=found["views"],
        dominant_sum=taken("dominant_sum", empty.dominant_sum),
        blurred=taken("blurred", empty.blurred),
    )
    return Training(Rows(arrays, m, v), statistics, run.step)


def _array(value: Any) -> np.ndarray:
    array = value.detach().cpu().numpy()
    return array.astype(np.float64) if array.dtype.kind == "f" else array
