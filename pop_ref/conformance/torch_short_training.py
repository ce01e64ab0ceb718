"""A torch trainer on photographs: it takes the steps of a `ShortTraining` or of a `Watch` as a run of a user does.

Settings, capture and engine are those that a run has. Nothing is written, but where a run is run to its end.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from typing import Any

import numpy as np

from pop_ref.conformance.short_training import BACKGROUND, VIEWS, ShortTraining, Watch
from pop_ref.conformance.torch_strategy import arrays_of
from pop_ref.methods import KEYS
from pop_ref.settings import AppearanceRates, LearningRates

# settings of a training by the names of `Recipe` that a run calls otherwise
_NAMES = {"pixelwise": "photometric", "padding": "ssim_padding"}
# what a strategy keeps of a window
KEPT = ("grad2d", "count", "views", "dominant_sum", "blurred", "radii", "sh_rest_sum")
STILL = LearningRates(means=0.0, scales=0.0, quats=0.0, opacities=0.0, sh0=0.0, sh_rest=0.0)


class _InterruptedError(Exception):
    """Raised in the middle of a run."""


class _Drawing:
    """A strategy by gsplat's protocol that changes nothing, and draws a number with torch's own generator at a step."""

    def __init__(self, rand: Callable[[int], Any]) -> None:
        self._rand = rand
        self.drawn: list[float] = []

    def check_sanity(self, params: Any, optimizers: Any) -> None:
        """Take any parameters."""

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """Remember nothing."""
        return {}

    def step_pre_backward(self, *given: Any) -> None:
        """Ask for no gradient."""

    def step_post_backward(self, *given: Any, packed: bool = False) -> None:
        """Draw a number."""
        self.drawn.append(float(self._rand(1)))


class Trainee:
    """Takes steps on photographs: those of a short training, or of one that moves nothing.

    Args:
        package: a trainer laid out as `pop_fast` is.
        backend: of it, by name.
        dtype: "float32" or "float64".
    """

    def __init__(self, package: str, backend: str, dtype: str) -> None:
        self._package, self._backend = package, backend
        self._torch: Any = importlib.import_module("torch")
        self._float = getattr(self._torch, dtype)

    def _module(self, name: str) -> Any:
        return importlib.import_module(f"{self._package}.{name}")

    def taken_steps(
        self, short: ShortTraining, before: Sequence[Mapping[str, Any]] | None = None
    ) -> list[dict[str, Any]]:
        """See `pop_ref.short_training.taken_steps`; the order of the views is the run's own, unless `before` is told.

        Raises:
            ValueError: the Gaussians that a step begins with are of another number than the step before has left.
        """
        run = self._run(short) if before is None else self._run(short, seed=self._seed_of(short))
        found: list[dict[str, Any]] = []
        for step in range(short.steps):
            if before is not None:
                self._begin_with(run, before[step])
            found.append(self._taken(run, step))
        return found

    def _seed_of(self, short: ShortTraining) -> int:
        """Return a seed of a run that sees the views in the order of the short training."""
        order = list(short.order)
        return next(k for k in range(100_000) if self.view_order(short.views, k, len(order)) == order)

    def _begin_with(self, run: Any, record: Mapping[str, Any]) -> None:
        with self._torch.no_grad():
            for key in KEYS:
                state = run.optimizers[key].state[run.params[key]]
                held = {"params": run.params[key], "m": state["exp_avg"], "v": state["exp_avg_sq"]}
                for kind, tensor in held.items():
                    given = self._torch.as_tensor(record[kind][key])
                    if tensor.shape != given.shape:
                        raise ValueError(f"{len(tensor)} Gaussians are left, and {len(given)} begin the next step")
                    tensor.copy_(given)

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
        rates = AppearanceRates(exposures=rate, exposures_decay=1.0)
        run = self._run(short, exposure=True, appearance_lr=rates, coarse_stop_iters=stops)
        found: list[np.ndarray] = []
        for step in range(short.steps):
            self._step(run, step)
            found.append(arrays_of(run.appearance.params["exposures"]))
        return found

    def foreign_steps(self, short: ShortTraining) -> list[dict[str, Any]]:
        """Take the steps of a run that is given the method as somebody else's strategy, by gsplat's protocol."""
        run = self._run(short, foreign=True)
        return [self._taken(run, step) for step in range(short.steps)]

    def foreign_draws(self, short: ShortTraining) -> tuple[list[float], bool]:
        """Let somebody else's strategy draw a random number after every step.

        Returns:
            The numbers, and whether those that everybody draws are left as they were.
        """
        strategy = _Drawing(self._torch.rand)
        run, before = self._run(short, foreign=strategy), self._torch.get_rng_state()
        for step in range(short.steps):
            self._step(run, step)
        return strategy.drawn, bool(self._torch.equal(self._torch.get_rng_state(), before))

    def corrected_steps(
        self, short: ShortTraining, corrections: np.ndarray, rate: float = 0.0
    ) -> tuple[list[dict[str, Any]], np.ndarray]:
        """Take steps with cameras that are corrected; return them, and the cameras that are left.

        Args:
            short: what is trained, from cameras that are not corrected.
            corrections: of every camera, without a motion that all share. [V, 6]
            rate: at which they are learned; at 0 they stay.
        """
        run = self._run(short, refine_cameras=True, appearance_lr=AppearanceRates(cameras=rate, cameras_decay=1.0))
        with self._torch.no_grad():
            run.appearance.params["cameras"].copy_(self._torch.as_tensor(corrections))
        taken = [self._taken(run, step) for step in range(short.steps)]
        seen = run.appearance.seen(self._views_of(run))
        return taken, np.stack([arrays_of(view.viewmat[0]) for view in seen])

    def coarse_losses(self, short: ShortTraining, stops: tuple[int, ...]) -> list[float]:
        """Return the loss of every step where the first ones see their photographs shrunk: `coarse_stop_iters`."""
        run = self._run(short, coarse_stop_iters=stops)
        return [self._taken(run, step)["loss"] for step in range(short.steps)]

    def coarse_view(self, photo: np.ndarray, mask: np.ndarray | None, K: np.ndarray, factor: int) -> dict[str, Any]:
        """Return photograph, mask, intrinsics and opacity of a view that is shrunk by a power of 2, as far as it is.

        Its opacity is the photograph's first channel.
        """
        tensor, of = self._torch.as_tensor, self._module("train.views")
        view = of.ViewTensors(
            name="0", photo=tensor(photo), mask=None if mask is None else tensor(mask),
            alpha=tensor(photo)[..., 0].contiguous(),
            viewmat=self._torch.eye(4, dtype=self._float)[None], K=tensor(K).to(self._float)[None],
        )  # fmt: skip
        small = of.shrunk(view, factor)
        return arrays_of({"photo": small.photo, "mask": small.mask, "K": small.K[0], "alpha": small.alpha})

    def whole_run(self, short: ShortTraining, folder: str) -> list[np.ndarray]:
        """Run to the end, with all that a run writes, and return the parameters."""
        run = self._run(short, folder)
        run.run()
        return arrays_of([run.params[key] for key in KEYS])

    def resumed_run(self, short: ShortTraining, folder: str, after: int, **more: Any) -> list[dict[str, np.ndarray]]:
        """Return what a run leaves by name that goes to its end at once, and one that is interrupted and resumed.

        Both are in single precision, which checkpoints hold, and draw their random numbers themselves.

        Args:
            short: what is trained.
            folder: where both are written.
            after: so many steps the second is interrupted.
            more: further settings of a run.
        """
        single, saved = Trainee(self._package, self._backend, "float32"), {"save_steps": (after,), **more}
        whole, broken = (single._run(short, f"{folder}/{name}", **saved) for name in ("whole", "broken"))

        def interrupt(run: Any) -> None:
            if run.step == after:
                raise _InterruptedError

        broken._watch = interrupt
        del whole.draws, broken.draws
        whole.run()
        with suppress(_InterruptedError):
            broken.run()
        again = single._run(short, f"{folder}/broken", resume=True, **saved)
        del again.draws
        again.run()
        return [_left_by(run) for run in (whole, again)]

    def _views_of(self, run: Any) -> list[Any]:
        of = self._module("train.views").ViewTensors.of
        return [of(view, self._float) for view in run._capture.train_views(run.config.test_every)]

    def _step(self, run: Any, step: int) -> Any:
        # with the threads that a run has, on whose number the order of sums may depend
        environment = self._module("train.environment")
        with environment.reproducible(run.config.threads):
            return run.take_steps(step + 1)

    def _taken(self, run: Any, step: int) -> dict[str, Any]:
        segment = self._step(run, step)
        (stats,), (names,) = segment.stats, segment.views
        views = [int(name.removesuffix(".png")) for name in names.split(", ")]
        moments = run.stepper.moments()
        return {
            "view": views[0] if len(views) == 1 else views,
            "loss": float(stats.objective + stats.pop),
            "params": arrays_of({key: run.params[key] for key in KEYS}),
            "m": arrays_of({key: moments[key]["exp_avg"] for key in KEYS}),
            "v": arrays_of({key: moments[key]["exp_avg_sq"] for key in KEYS}),
        }

    def _run(
        self, short: ShortTraining, folder: str = "", foreign: Any = None, resume: bool = False, **more: Any
    ) -> Any:
        """Return a run of the short training; the engine is the one that its settings have."""
        initial = {key: self._torch.as_tensor(value).to(self._float) for key, value in short.params.items()}
        config = self._config(short, folder, more)
        # in single precision a run chooses its engine itself
        engine = None if self._float == self._torch.float32 else self._engine(config)
        TrainingRun = self._module("train.training_run").TrainingRun
        strategy = config.strategy if foreign is True else foreign
        given = {"initial": initial, "engine": engine, "strategy": strategy, "resume": resume}
        run = TrainingRun(config, self._capture(short), **given)
        drawn, Draws = short.draws(), self._module("density.protocol").Draws
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
        # the native step shares its work out, and has the same bits for any number of threads
        threads = 2 if self._backend == "compiled" else 1
        said |= {
            "sh_degree": short.degree, "threads": threads, "progress": False, "backend": self._backend, "test_every": 0,
            "batch_size": short.batch, "background": short.background, "antialiased": short.antialiased,
        }  # fmt: skip
        return self._module("train.config").TrainConfig.of(
            method=short.method, **said, **({"result_dir": folder} if folder else {}), **more
        )

    def _capture(self, short: ShortTraining) -> Any:
        data = self._module("data.capture")

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

    def collected_statistics(self, watch: Watch) -> list[dict[str, Any]]:
        """Return what the strategy's state holds after every step, by the names of KEPT, parameters and moments."""
        config, strategy = self._settings(watch)
        params, views = self._params(watch), self._views(watch)
        schedule = self._module("train.schedule")
        appearance = self._module("train.appearance").Appearance(config, views)
        stepper, _, state = self._stepper(config, strategy, views, watch, appearance, params)
        found: list[dict[str, Any]] = []
        for step in range(watch.steps):
            stepper.steps(step, step + 1, schedule.phase_at(config, strategy, step))
            stepper.synchronize()
            moments = {name: of["exp_avg"] for name, of in stepper.moments().items()}
            kept = {name: state.get(name) for name in KEPT}
            found.append(arrays_of({**kept, "params": params, "first_moments": moments}))
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
        return arrays_of({
            **{name: getattr(found, name) for name in sums},
            "sensitivities": passes.sensitivities(params, view, 2),
            # which leave out how antialiased opacities depend on scales, and say so
            "blocks": None if watch.antialiased else passes.fisher(params, view, 2, divisor),
            "points": points,
            "ids": ids,
            "T_final": T_final,
        })  # fmt: skip

    def written_meta(self, watch: Watch) -> list[str]:
        """Write to every key of a view's meta before it is read, and return those that forget it."""
        config, _ = self._settings(watch)
        views, backend = self._module("train.views"), self._module("api.backend").require_backend(self._backend)
        meta = views.render_view(backend, self._params(watch), self._views(watch)[0], config, 2).info
        for name in list(meta):
            meta[name] = name
        return [name for name in list(meta) if meta[name] != name]

    def blank_losses(self, watch: Watch, exposure: np.ndarray, seed: int, opaque: bool) -> list[float]:
        """Return the photometric loss of steps over random backgrounds, with nothing drawn and black photographs.

        Args:
            watch: the steps; its background, over which photographs have been laid, is left out: it is black.
            exposure: of every photograph. [3, 4]
            seed: of the run.
            opaque: whether photographs are; otherwise all of them is clear.
        """
        config, strategy = self._settings(watch)
        config = replace(config, background=(0.0, 0.0, 0.0), random_background=True, exposure=True, seed=seed,
                         appearance_lr=AppearanceRates(exposures=0.0))  # fmt: skip
        views = []
        for view in self._views(watch):
            blank = self._torch.zeros_like(view.photo)
            views.append(replace(view, photo=blank, alpha=None if opaque else blank[..., 0]))
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
        made = self._module("train.presets").METHODS[method].strategy()
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


def photograph_stages(package: str, backend: str, dtype: str) -> dict[str, Callable[..., Any]]:
    """Return the stage functions that take the steps of a `ShortTraining` or of a `Watch`."""
    trainee = Trainee(package, backend, dtype)
    return {name: getattr(trainee, name) for name in vars(Trainee) if not name.startswith("_")}


def _left_by(run: Any) -> dict[str, np.ndarray]:
    """Return all numbers that a run would go on from, by name."""
    found: dict[str, Any] = {name: run.state.get(name) for name in KEPT}
    found |= {"generator": run.state["generator"].get_state(), "order": run._order.ahead(2 * len(run._train))}
    for key in KEYS:
        moments = run.optimizers[key].state[run.params[key]]
        found |= {key: run.params[key], **{f"{name} of {key}": value for name, value in moments.items()}}
    for key, learned in run.appearance.state_dict().items():
        found |= {f"{name} of {key}": value for name, value in learned.items()}
    return {name: np.asarray(arrays_of(value)) for name, value in found.items() if value is not None}
