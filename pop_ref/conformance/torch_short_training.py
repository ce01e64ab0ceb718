"""A torch trainer that takes the steps of a `ShortTraining` as a run of a user does: settings, capture and engine.

Nothing is written: a run writes when it is run to its end, and here steps are asked for one by one.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from pop_ref.conformance.short_training import DEGREE, ShortTraining
from pop_ref.methods import KEYS

# settings of a training by the names of `Recipe` that a run calls otherwise
_NAMES = {"pixelwise": "photometric", "padding": "ssim_padding"}


class Trainee:
    """Takes steps of a run.

    Args:
        package: a trainer laid out as `pop_fast` is.
        backend: of it, by name.
        dtype: "float32" or "float64".
    """

    def __init__(self, package: str, backend: str, dtype: str) -> None:
        self._package, self._backend = package, backend
        self._torch: Any = importlib.import_module("torch")
        self._float = getattr(self._torch, dtype)

    def taken_steps(self, short: ShortTraining) -> list[dict[str, Any]]:
        """See `pop_ref.short_training.taken_steps`; the order of the views is the run's own."""
        run = self._run(short)
        return [self._taken(run, step) for step in range(short.steps)]

    def batched_steps(self, short: ShortTraining) -> list[dict[str, Any]]:
        """Take steps of several views each: "view" lists them."""
        return self.taken_steps(short)

    def learned_exposures(self, short: ShortTraining, rate: float, stops: tuple[int, ...] = ()) -> list[np.ndarray]:
        """Return the exposures of all photographs after every step, of which each learns at a rate. [V, 3, 4]

        Args:
            short: what is trained.
            rate: of exposures.
            stops: `coarse_stop_iters`: the first steps see their photographs shrunk.
        """
        config = importlib.import_module("pop_ref.settings")
        rates = config.AppearanceRates(exposures=rate, exposures_decay=1.0)
        run = self._run(short, exposure=True, appearance_lr=rates, coarse_stop_iters=stops)
        found: list[np.ndarray] = []
        for step in range(short.steps):
            self._step(run, step)
            found.append(_array(run.appearance.params["exposures"]))
        return found

    def coarse_losses(self, short: ShortTraining, stops: tuple[int, ...]) -> list[float]:
        """Return the loss of every step where the first ones see their photographs shrunk: `coarse_stop_iters`."""
        run = self._run(short, coarse_stop_iters=stops)
        return [self._taken(run, step)["loss"] for step in range(short.steps)]

    def coarse_view(self, photo: np.ndarray, mask: np.ndarray | None, K: np.ndarray, factor: int) -> dict[str, Any]:
        """Return photograph, mask and intrinsics of a view that is shrunk by a power of 2, as far as it is."""
        tensor, of = self._torch.as_tensor, importlib.import_module(f"{self._package}.train.views")
        view = importlib.import_module(f"{self._package}.train.views").ViewTensors(
            name="0", photo=tensor(photo), mask=None if mask is None else tensor(mask),
            viewmat=self._torch.eye(4, dtype=self._float)[None], K=tensor(K).to(self._float)[None],
        )  # fmt: skip
        small = of.shrunk(view, factor)
        kept = None if small.mask is None else _array(small.mask)
        return {"photo": _array(small.photo), "mask": kept, "K": _array(small.K[0])}

    def whole_run(self, short: ShortTraining, folder: str) -> list[np.ndarray]:
        """Run to the end, with all that a run writes, and return the parameters."""
        run = self._run(short, folder)
        run.run()
        return [_array(run.params[key]) for key in KEYS]

    def _step(self, run: Any, step: int) -> Any:
        # with the threads that a run has, on whose number the order of sums may depend
        environment = importlib.import_module(f"{self._package}.train.environment")
        with environment.reproducible(run.config.threads):
            return run.take_steps(step + 1)

    def _taken(self, run: Any, step: int) -> dict[str, Any]:
        segment = self._step(run, step)
        (stats,), (names,) = segment.stats, segment.views
        views = [int(name.removesuffix(".png")) for name in names.split(", ")]
        moments = {key: run.optimizers[key].state[run.params[key]] for key in KEYS}
        return {
            "view": views[0] if len(views) == 1 else views,
            "loss": float(stats.objective + stats.pop),
            "params": {key: _array(run.params[key]) for key in KEYS},
            "m": {key: _array(moments[key]["exp_avg"]) for key in KEYS},
            "v": {key: _array(moments[key]["exp_avg_sq"]) for key in KEYS},
        }

    def _run(self, short: ShortTraining, folder: str = "", **more: Any) -> Any:
        """Return a run of the short training; the engine is the one that its settings have."""
        initial = {key: self._torch.as_tensor(value).to(self._float) for key, value in short.params.items()}
        config = self._config(short, folder, more)
        engine = None
        if self._float != self._torch.float32:
            # whole steps are taken in single precision
            engine = importlib.import_module(f"{self._package}.train.engines").torch_engine(self._backend)
        TrainingRun = importlib.import_module(f"{self._package}.train.training_run").TrainingRun
        run = TrainingRun(config, self._capture(short), initial=initial, engine=engine)
        drawn, Draws = short.draws(), importlib.import_module(f"{self._package}.density.protocol").Draws
        run.draws = Draws(
            lambda n: self._torch.as_tensor(drawn.normals(n)), lambda n: self._torch.as_tensor(drawn.uniforms(n))
        )
        return run

    def _config(self, short: ShortTraining, folder: str, more: Mapping[str, Any]) -> Any:
        """Return the settings of a run of the method, of which those that the short training names are said."""
        said: dict[str, Any] = {f"{short.method}.{name}": value for name, value in short.settings.items()}
        for name, value in short.options.items():
            if name == "pixel_scale":
                said["photometric_divisor"] = 1.0 / value
            elif name == "profile":
                said["profile"] = value.name
            elif name == "lr":
                said |= {f"lr.{f.name}": getattr(value, f.name) for f in fields(value)}
            else:
                said[_NAMES.get(name, name)] = value
        said |= {
            "sh_degree": DEGREE, "threads": 1, "progress": False, "backend": self._backend, "test_every": 0,
            "batch_size": short.batch, "background": short.background, "antialiased": short.antialiased,
        }  # fmt: skip
        return importlib.import_module(f"{self._package}.train.config").TrainConfig.of(
            method=short.method, **said, **({"result_dir": folder} if folder else {}), **more
        )

    def _capture(self, short: ShortTraining) -> Any:
        data = importlib.import_module(f"{self._package}.data.capture")

        class Scaled(data.Capture):
            """A capture whose scale is told."""

            def scene_scale(self) -> float:
                return short.scene_scale

        every = [*short.cameras, *short.held_out_cameras]
        views = [
            data.View(
                f"{k:03d}.png", short.photo(k), camera.viewmat, camera.K, short.mask(k),
                split=None if not short.held_out else "train" if k < short.views else "test",
                seen=short.seen(k).astype(np.int32) if short.sparse else None,
            )
            for k, camera in enumerate(every)
        ]  # fmt: skip
        points = short.cloud if short.sparse else np.zeros((1, 3))
        return Scaled("short", tuple(views), points, np.zeros((len(points), 3), np.uint8), source="formulas")


def short_training_stages(package: str, backend: str, dtype: str) -> dict[str, Callable[..., Any]]:
    """Return the stage functions that take the steps of a `ShortTraining`."""
    trainee = Trainee(package, backend, dtype)
    names = ("taken_steps", "batched_steps", "learned_exposures", "coarse_losses", "coarse_view", "whole_run")
    return {name: getattr(trainee, name) for name in names}


def _array(value: Any) -> np.ndarray:
    array = value.detach().cpu().numpy().copy()
    return array.astype(np.float64) if array.dtype.kind == "f" else array
