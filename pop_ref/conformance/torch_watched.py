"""A torch trainer that takes the steps of a `Watch`, by the stepper and the engine that a run of its settings has."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from pop_ref.conformance.watched import BACKGROUND, VIEWS, Watch
from pop_ref.settings import LearningRates

# what a strategy keeps of a window
KEPT = ("grad2d", "count", "views", "dominant_sum", "blurred", "radii", "sh_rest_sum")
STILL = LearningRates(means=0.0, scales=0.0, quats=0.0, opacities=0.0, sh0=0.0, sh_rest=0.0)


class Watcher:
    """Takes steps of a training that moves nothing.

    Args:
        package: a trainer laid out as `pop_fast` is.
        backend: of it, by name.
        dtype: "float32" or "float64".
    """

    def __init__(self, package: str, backend: str, dtype: str) -> None:
        self._package, self._backend = package, backend
        self._torch: Any = importlib.import_module("torch")
        self._float = getattr(self._torch, dtype)

    def collected_statistics(self, watch: Watch) -> list[dict[str, Any]]:
        """Return what the strategy's state holds after every step, by the names of KEPT, and the parameters."""
        config, strategy = self._settings(watch)
        params = self._params(watch)
        make = self._module("train.model").make_optimizers
        optimizers, state = make(params), strategy.initialize_state(1.0, count=len(params["means"]))
        views, stepper_module = self._views(watch), self._module("train.stepper")
        schedule = self._module("train.schedule")
        appearance = self._module("train.appearance").Appearance(config, views)
        updates = schedule.updates_of_strategy(config, strategy, 1.0)
        task = stepper_module.Task(config, strategy, views, list(watch.order), updates, 0, appearance)
        stepper = self._engine(config).make_stepper(task)
        stepper.rebind(params, optimizers, state)
        found: list[dict[str, Any]] = []
        for step in range(watch.steps):
            stepper.steps(step, step + 1, schedule.phase_at(config, strategy, step))
            stepper.synchronize()
            found.append({name: _array(state.get(name)) for name in KEPT} | {"params": _arrays(params)})
        return found

    def view_passes(self, watch: Watch, view: int, divisor: int) -> dict[str, Any]:
        """Return what passes over a training view of the Gaussians sum: contributions, scores, blocks, points."""
        config, _ = self._settings(watch)
        protocol = self._module("density.passes")
        passes = protocol.Passes.of(self._module("api.registry").require_backend(self._backend), self._views(watch),
                                    config)  # fmt: skip
        params = {name: value.detach() for name, value in self._params(watch).items()}
        H, W = watch.cameras[view].height, watch.cameras[view].width
        weights = self._torch.arange(H * W).reshape(H, W).to(self._float) % 7.0
        found = passes.contributions(params, view, 2, weights)
        points, ids, T_final = passes.dominant_points(params, view, 2)
        sums = ("weight_sum", "n_pixels", "map_sum", "distance_sum", "dominant_counts", "image", "radii", "depths")
        return {name: _array(getattr(found, name)) for name in sums} | {
            "sensitivities": _array(passes.sensitivities(params, view, 2)),
            "blocks": _array(passes.fisher(params, view, 2, divisor)),
            "points": _array(points),
            "ids": _array(ids),
            "T_final": _array(T_final),
        }

    def _module(self, name: str) -> Any:
        return importlib.import_module(f"{self._package}.{name}")

    def _settings(self, watch: Watch) -> tuple[Any, Any]:
        strategy = self._module("density").POPStrategy(**watch.settings)
        config = self._module("train.config").TrainConfig(
            strategy=strategy, lr=STILL, lambda_ssim=0.0, sh_degree=2, sh_interval=watch.sh_interval, threads=1,
            batch_size=watch.batch, background=BACKGROUND, antialiased=watch.antialiased, backend=self._backend,
            progress=False,
        )  # fmt: skip
        return config, strategy

    def _engine(self, config: Any) -> Any:
        engines = self._module("train.engines")
        # whole steps are taken in single precision
        return engines.engine_of(config) if self._float == self._torch.float32 else engines.torch_engine(self._backend)

    def _params(self, watch: Watch) -> dict[str, Any]:
        make = self._torch.nn.Parameter
        return {name: make(self._torch.as_tensor(value).to(self._float)) for name, value in watch.params.items()}

    def _views(self, watch: Watch) -> list[Any]:
        ViewTensors = self._module("train.views").ViewTensors
        found = []
        for k, camera in enumerate(watch.cameras[:VIEWS]):
            mask = watch.mask(k)
            given = {
                "photo": self._torch.as_tensor(watch.photo(k)),
                "mask": None if mask is None else self._torch.as_tensor(mask),
                "viewmat": self._torch.as_tensor(camera.viewmat).to(self._float)[None],
                "K": self._torch.as_tensor(camera.K).to(self._float)[None],
            }
            found.append(ViewTensors(name=str(k), **given))
        return found


def watching_stages(package: str, backend: str, dtype: str) -> dict[str, Any]:
    """Return the stage functions that take the steps of a `Watch`."""
    watcher = Watcher(package, backend, dtype)
    return {name: getattr(watcher, name) for name in ("collected_statistics", "view_passes")}


def _array(value: Any) -> Any:
    if hasattr(value, "detach"):
        array = value.detach().cpu().numpy().copy()
        return array.astype(np.float64) if array.dtype.kind == "f" else array
    return value


def _arrays(params: dict[str, Any]) -> dict[str, np.ndarray]:
    return {name: _array(value) for name, value in params.items()}
