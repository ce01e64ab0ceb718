"""A torch trainer that takes the steps of a `Watch`, by the stepper and the engine that a run of its settings has."""

from __future__ import annotations

import importlib
from dataclasses import fields, replace
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
        """Return what the strategy's state holds after every step, by the names of KEPT, parameters and moments."""
        config, strategy = self._settings(watch)
        params, views = self._params(watch), self._views(watch)
        schedule = self._module("train.schedule")
        appearance = self._module("train.appearance").Appearance(config, views)
        stepper, optimizers, state = self._stepper(config, strategy, views, watch, appearance, params)
        found: list[dict[str, Any]] = []
        for step in range(watch.steps):
            stepper.steps(step, step + 1, schedule.phase_at(config, strategy, step))
            stepper.synchronize()
            moments = {name: each.state[params[name]]["exp_avg"] for name, each in optimizers.items()}
            kept = {name: _array(state.get(name)) for name in KEPT}
            found.append(kept | {"params": _arrays(params), "first_moments": _arrays(moments)})
        return found

    def view_passes(self, watch: Watch, view: int, divisor: int) -> dict[str, Any]:
        """Return what passes over a training view of the Gaussians sum: contributions, scores, blocks, points."""
        config, _ = self._settings(watch)
        protocol = self._module("density.passes")
        passes = protocol.Passes.of(self._module("api.backend").require_backend(self._backend), self._views(watch),
                                    config)  # fmt: skip
        params = {name: value.detach() for name, value in self._params(watch).items()}
        H, W = watch.cameras[view].height, watch.cameras[view].width
        weights = self._torch.arange(H * W).reshape(H, W).to(self._float) % 7.0
        found = passes.contributions(params, view, 2, weights)
        points, ids, T_final = passes.dominant_points(params, view, 2)
        sums = ("weight_sum", "n_pixels", "map_sum", "distance_sum", "dominant_counts", "image", "radii", "depths")
        return {name: _array(getattr(found, name)) for name in sums} | {
            "sensitivities": _array(passes.sensitivities(params, view, 2)),
            # which leave out how antialiased opacities depend on scales, and say so
            "blocks": None if watch.antialiased else _array(passes.fisher(params, view, 2, divisor)),
            "points": _array(points),
            "ids": _array(ids),
            "T_final": _array(T_final),
        }

    def written_meta(self, watch: Watch) -> list[str]:
        """Write to every key of a view's meta before it is read, and return those that forget it."""
        config, _ = self._settings(watch)
        views, backend = self._module("train.views"), self._module("api.backend").require_backend(self._backend)
        meta = views.render_view(backend, self._params(watch), self._views(watch)[0], config, 2).info
        for name in list(meta):
            meta[name] = name
        return [name for name in list(meta) if meta[name] != name]

    def blank_losses(self, watch: Watch, exposure: np.ndarray) -> list[float]:
        """Return the photometric loss of steps over random backgrounds, with nothing drawn and clear photographs.

        Args:
            watch: the steps; its background, over which photographs have been laid, is left out: it is black.
            exposure: of every photograph. [3, 4]
        """
        config, strategy = self._settings(watch)
        config = replace(config, background=(0.0, 0.0, 0.0), random_background=True, exposure=True)
        views = []
        for view in self._views(watch):
            blank = self._torch.zeros_like(view.photo)
            views.append(replace(view, photo=blank, alpha=blank[..., 0]))
        params = self._params(watch)
        with self._torch.no_grad():
            params["opacities"].fill_(-30.0)
        appearance = self._module("train.appearance").Appearance(config, views)
        with self._torch.no_grad():
            appearance.params["exposures"].copy_(self._torch.as_tensor(exposure))
        stats = self._stepper(config, strategy, views, watch, appearance, params)[0]
        schedule = self._module("train.schedule")
        taken = (stats.steps(k, k + 1, schedule.phase_at(config, strategy, k)) for k in range(watch.steps))
        return [float(each.objective) for step in taken for each in step]

    def view_order(self, n_views: int, seed: int, count: int) -> list[int]:
        """Return the views of the first steps of a training of a view a step."""
        order = self._module("train.schedule").ViewOrder(n_views, seed)
        return [order.next() for _ in range(count)]

    def scaled_settings(self, method: str, factor: float) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return a method's settings by name, and those of a schedule so many times as long."""
        strategy = {"pop": "POPStrategy", "3dgs": "InriaStrategy"}[method]
        made = getattr(self._module("density"), strategy)()
        own, scaled = ({f.name: getattr(each, f.name) for f in fields(each)} for each in (made, made.scaled(factor)))
        return own, scaled

    def _stepper(
        self, config: Any, strategy: Any, views: list[Any], watch: Watch, appearance: Any, params: dict[str, Any]
    ) -> tuple[Any, Any, Any]:
        """Return what takes the steps of a watch, its optimizers and the strategy's state."""
        optimizers = self._module("train.model").make_optimizers(params)
        state = strategy.initialize_state(1.0, count=len(params["means"]))
        updates = self._module("train.schedule").updates_of_strategy(config, strategy, 1.0)
        given = (config, strategy, views, list(watch.order), updates, 0, appearance)
        stepper = self._engine(config).make_stepper(self._module("train.stepper").Task(*given))
        stepper.rebind(params, optimizers, state)
        return stepper, optimizers, state

    def _module(self, name: str) -> Any:
        return importlib.import_module(f"{self._package}.{name}")

    def _settings(self, watch: Watch) -> tuple[Any, Any]:
        strategy = self._module("density").POPStrategy(**watch.settings)
        config = self._module("train.config").TrainConfig(
            strategy=strategy, lr=STILL, lambda_ssim=0.0, sh_degree=2, sh_interval=watch.sh_interval, threads=1,
            batch_size=watch.batch, background=BACKGROUND, antialiased=watch.antialiased, backend=self._backend,
            progress=False, **watch.regularizers,
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
    names = ("collected_statistics", "view_passes", "written_meta", "blank_losses", "view_order", "scaled_settings")
    return {name: getattr(watcher, name) for name in names}


def _array(value: Any) -> Any:
    if hasattr(value, "detach"):
        array = value.detach().cpu().numpy().copy()
        return array.astype(np.float64) if array.dtype.kind == "f" else array
    return value


def _arrays(params: dict[str, Any]) -> dict[str, np.ndarray]:
    return {name: _array(value) for name, value in params.items()}
