"""A training run: schedule, densification steps, records, measurements and checkpoints; a `Stepper` takes its steps.

Everything random comes from generators that are seeded by the config and saved in checkpoints; the same config,
capture, engine, machine and number of threads give the same bits, whether a run was interrupted or not; those of the
native step do not depend on the number of threads either.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor
from torch.nn import Parameter
from tqdm import tqdm

from pop_fast.data.capture import Capture
from pop_fast.data.gaussians import initialize_params
from pop_fast.density.passes import Passes
from pop_fast.density.protocol import DensificationStep, Draws, ForeignStrategy, Strategy
from pop_fast.errors import PopError
from pop_fast.io.heartbeat import Heartbeat, Pace, so_far
from pop_fast.io.ply import Frame, save_ply
from pop_fast.stages.covariance import opacities_from_logits
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.appearance import Appearance
from pop_fast.train.checkpoint import moved_to, on_cpu
from pop_fast.train.choose import choose_backend
from pop_fast.train.config import TrainConfig
from pop_fast.train.engines import engine_of, translate_oom
from pop_fast.train.environment import reproducible, run_facts, versions
from pop_fast.train.evaluate import evaluate, population
from pop_fast.train.lpips import load_nets
from pop_fast.train.model import KEYS, make_optimizers, require_usable
from pop_fast.train.preflight import check_method, check_start, check_views, facts, find_warnings
from pop_fast.train.ranks import ALONE, Ranks
from pop_fast.train.results import ResultFolder, Segment, Times, record_of
from pop_fast.train.schedule import (
    ViewOrder,
    active_sh_degree,
    is_milestone,
    phase_at,
    reads_rows,
    segment_end,
    updates_of_strategy,
)
from pop_fast.train.signals import Abandoned, StopRequest, stop_requests
from pop_fast.train.stepper import Engine, Stepper, Task
from pop_fast.train.steps import Phase, StepStats
from pop_fast.train.torch_stepper import check_batch
from pop_fast.train.views import ViewTensors, coarse_to_fine

Watch = Callable[["TrainingRun"], None]
_WATCHED_STEPS: Final = 5  # at a time, between which a watch sees the run


class TrainingRun:
    """A run of one capture.

    Attributes:
        config: the settings as the run uses them.
        params: raw parameters by name. Where processes share the Gaussians out, colours are here only for who reads
            them; see `pop_fast.train.stepper.OwnRows`.
        optimizers: one Adam for each parameter.
        appearance: learned exposures and cameras.
        strategy: density control.
        state: the strategy's state.
        step: number of steps taken.
        updates: which parameters Adam moves at which step.
    """

    def __init__(
        self,
        config: TrainConfig,
        capture: Capture,
        *,
        resume: bool = False,
        overwrite: bool = False,
        loading_seconds: float = 0.0,
        sfm_seconds: float = 0.0,
        beside: Mapping[str, str] | None = None,
        strategy: Strategy | None = None,
        initial: Mapping[str, Tensor] | None = None,
        engine: Engine | None = None,
        ranks: Ranks = ALONE,
        watch: Watch | None = None,
    ) -> None:
        """Prepare a run; nothing is written yet.

        Args:
            config: the settings.
            capture: the photographs and cameras.
            resume: continue from the latest checkpoint of `config.result_dir`, or start where there is none.
            overwrite: replace the results of an earlier run in `config.result_dir` after the first step.
            loading_seconds, sfm_seconds: durations of reading and of the search for cameras, for the statistics.
            beside: texts to write next to cfg.json, by file name.
            strategy: replaces the strategy of the config, with gsplat's protocol; on the CPU.
            initial: raw parameters to start from, which are copied; None makes them from the capture's points. The
                training has their precision; a GPU trains in float32 only.
            engine: takes the steps; None takes the one for `config.backend`.
            ranks: the processes that train together, of which this is one; the first one writes.
            watch: called with the run between steps; it must not change the run. With it, fewer steps are taken at a
                time. Of several processes the one that writes has it, which has all Gaussians then.

        Raises:
            PopError: the capture cannot be trained on, weights are missing, or the backend is not available or does
                not know a setting.
        """
        check_batch(config, strategy is None, ranks)
        check_method(config)
        self._ranks = ranks
        self._engine = engine_of(choose_backend(config, resume)[0], strategy is None) if engine is None else engine
        self.config = replace(config, backend=self._engine.name).in_world(capture.world_scale)
        self._resume, self._overwrite, self._beside = resume, overwrite, beside or {}
        self._prepare_capture(capture, initial)
        self.optimizers = make_optimizers(self.params)
        self.strategy = self.config.strategy if strategy is None else ForeignStrategy(strategy)
        self.strategy.check_sanity(self.params, self.optimizers)
        first = len(self.params["means"])
        self.state = self.strategy.initialize_state(self._scene_scale, seed=self.config.seed, count=first)
        self.updates = updates_of_strategy(self.config, self.strategy, self._scene_scale)
        self.step = 0
        self._watch, self._watched = watch, False
        self._stepper: Stepper | None = None
        self._stop = StopRequest()
        self._times = Times(loading_seconds, sfm_seconds)
        # the first Gaussians' opacities while the folder is still as it was found
        self._unwritten: np.ndarray | None = None
        self._latest = ""  # the training PSNR of the last record, in words

    def _prepare_capture(self, capture: Capture, initial: Mapping[str, Tensor] | None) -> None:
        config = self.config
        if initial is None:
            initial = initialize_params(capture, config.seed, config.init_opacity, config.init_scale)
        check_start(capture.name, initial)
        self.params = {key: Parameter(initial[key].clone(memory_format=torch.contiguous_format)) for key in KEYS}
        dtype, points = self.params["means"].dtype, capture.points if config.depth_lambda != 0.0 else None
        self._train = [ViewTensors.of(view, dtype, points) for view in capture.train_views(config.test_every)]
        self._test = [ViewTensors.of(view, dtype) for view in capture.test_views(config.test_every)]
        if not self._train:
            fix = "--test-every 1 holds all out: use 8, or 0 for none"
            if capture.has_own_split:
                fix = "its own lists hold all out: name photographs to train on there"
            raise PopError(f"{capture.name}: has no view to train on; {fix}")
        check_views(config, capture.name, self._train, self._test)
        self._nets = load_nets(config.lpips_vgg, config.lpips_alex, [(view.height, view.width) for view in self._test])
        self.appearance = Appearance(config, self._train)
        self._capture = capture
        self._scene_scale = capture.scene_scale()
        self._order = ViewOrder(len(self._train), config.seed)
        self._results = ResultFolder(config.result_dir)

    def run(self) -> dict[str, Any]:
        """Train to the end.

        A new run writes and replaces nothing before it has taken a step. If it cannot take one, the folder stays as it
        was.

        Returns:
            The statistics of the last step, as in stats/val_step{step}.json; none from a process that does not write.

        Raises:
            PopError: the folder is in use, a checkpoint does not fit, or a number is no longer finite.
            KeyboardInterrupt: after Ctrl-C or SIGTERM, when a checkpoint has been written; at once after the second
                one. The current step is abandoned and changes nothing; a resumed run makes the pending measurement.
        """
        if self._ranks.writes and not isinstance(self.strategy, ForeignStrategy):
            for warning in find_warnings(self.config, self._train):
                print(f"warning: {warning}", file=sys.stderr, flush=True)
        self._times.start()
        self._stop = StopRequest()
        with reproducible(self.config.threads), stop_requests(self._stop):
            try:
                self._begin()
                return self._loop()
            finally:
                self._results.close()

    def _begin(self) -> None:
        writes = self._ranks.writes
        if writes:
            self._results.hold()
            self._results.check(self._resume, self._overwrite)
        self._ranks.wait()
        with self._times.is_loading(), self._stop.abandoning(self._ranks.size == 1):
            # seconds of large photographs, for which a request to stop has no time
            _ = self._fingerprint
        found = ckpt.list_checkpoints(self._results.path) if self._resume else []
        if found:
            self._restore(found[-1][1])
            if writes:
                self._results.write_settings(self.config, self._beside)
        else:
            self._unwritten = self._opacities().numpy()
        own = {"settings": self.config.digest(), **self._fingerprint, "checkpoints": str(self.step)}
        self._ranks.require_alike(own)
        with self._times.is_loading():
            self._stepper = self.stepper
        due = found and writes and self.step in self.config.eval_steps
        if due and not self._results.read_stats("val", self.step - 1):  # as a stop was requested meanwhile
            self._evaluate(self.step - 1)

    def _loop(self) -> dict[str, Any]:
        config = self.config
        shown = config.progress and self._ranks.writes
        bars = tqdm(total=config.max_steps, initial=self.step, disable=None if shown else True)
        # also where another process shows the run: all take the same steps at a time
        self._watched = self._ranks.any(self._watch is not None)
        pace = Pace(self.step, self._times.train)
        with bars as bar, Heartbeat(shown, draw=bar.refresh) as beat:
            beat.say(f"step {self.step:,} of {config.max_steps:,}, {len(self.params['means']):,} Gaussians")
            while self.step < config.max_steps and not self._ranks.any(self._stop.asked):
                longest = min(self.stepper.longest, _WATCHED_STEPS if self._watched else config.max_steps)
                segment = self.take_steps(segment_end(config, self.strategy, self.step, longest))
                if segment.stats:
                    self._log(segment, bar)
                    n, rate = len(self.params["means"]), pace.steps_a_second(self.step, self._times.train)
                    beat.say(so_far(self.step, config.max_steps, n, rate, self._latest))
                    if self._unwritten is not None or self._watched or is_milestone(config, self.step):
                        self.stepper.gather()
                    if self._unwritten is not None:
                        # a rate can be so high that the first step is the last; that is no reason to replace anything
                        self._require_finite()
                        if self._ranks.writes:
                            self._results.begin(self.config, self._beside, self._unwritten, self._overwrite)
                        self._unwritten = None
                    self._milestones(self.step - 1)
                    if self._watch is not None:
                        self._watch(self)
            if self._ranks.any(self._stop.asked):
                # after the last step there is a checkpoint
                if self._unwritten is None and self.step < config.max_steps:
                    self._save()
                raise KeyboardInterrupt
        last = config.max_steps - 1
        return (self._results.read_stats("val", last) or self._evaluate(last)) if self._ranks.writes else {}

    def take_steps(self, last: int) -> Segment:
        """Take the steps up to `last`, and the densification step that is due after them.

        All are of one phase, and none but the last is followed by a densification step; see `segment_end`.

        Args:
            last: how many steps will have been taken, over `step`.

        Returns:
            What the steps measured and what became of the Gaussians; of fewer steps, or none, where somebody has
            asked for an end.

        Raises:
            PopError: a number is no longer finite; names it.
        """
        began, began_cpu = time.perf_counter(), time.process_time()
        first, before = self.step, len(self.params["means"])
        phase, stepper = phase_at(self.config, self.strategy, first), self.stepper
        size = self.config.batch_size
        with translate_oom():
            stats = self._measured(stepper, first, last, phase)
            densification = self._change(self.step - 1) if stats else None
        views = [", ".join(self._train[self._order.next()].name for _ in range(size)) for _ in stats]
        after = len(self.params["means"])
        seconds, seconds_cpu = time.perf_counter() - began, time.process_time() - began_cpu
        return Segment(first, phase, views, stats, densification, before, after, seconds, seconds_cpu)

    def _measured(self, stepper: Stepper, first: int, last: int, phase: Phase) -> list[StepStats]:
        try:
            stats = stepper.steps(first, last, phase)
        except ValueError as error:
            if isinstance(error, PopError):
                raise
            # the step that fails changes nothing, so that the parameters still say which entry it is
            self.step = stepper.step
            stepper.gather(everywhere=True)
            self._require_finite()
            raise PopError(f"{error}; {self._what_is_left}") from error
        self.step = stepper.step
        bad = [step for step, found in enumerate(stats, first) if not math.isfinite(found.objective + found.pop)]
        if bad or self._watched or self._unwritten is not None or reads_rows(self.config, self.strategy, self.step):
            stepper.synchronize()
        if bad:
            stepper.gather(everywhere=True)
        for step, found in enumerate(stats, first):
            if step in bad:
                self._require_finite()
                raise PopError(f"the loss of step {step} is {found.objective + found.pop}; {self._what_is_left}")
        return stats

    def _change(self, step: int) -> DensificationStep | None:
        """Let density control edit the Gaussians, if that is due."""
        if not self.strategy.changes_after(step):
            return None
        if self.strategy.reads_colors(step):
            self.stepper.gather(everywhere=True)
        passes = self._passes if self.strategy.needs_passes(step) else None
        given = (self.params, self.optimizers, self.state, step, self.draws)
        densification = self.strategy.change(*given, passes=passes, sh_degree=self.sh_degree(step))
        # processes that exchange tensors of other lengths are ended by gloo
        self._ranks.require_same({"count": torch.tensor(len(self.params["means"]))}, self.step)
        self.stepper.rebind(self.params, self.optimizers, self.state)
        return densification

    @cached_property
    def draws(self) -> Draws:
        """What changes of the Gaussians are decided by, the same numbers whatever takes the steps."""
        return Draws.of(self.state["generator"])

    @cached_property
    def _passes(self) -> Passes:
        """What a change of the Gaussians sees of the training views."""
        views = self.appearance.seen(self._train)
        return Passes.of(self._engine.backend, views, self.config, self._engine.device)

    @property
    def stepper(self) -> Stepper:
        """What takes the steps; it is made at the first use, for the rows as they are then, on the engine's device."""
        if self._stepper is None:
            if self._engine.device.type != "cpu":
                with translate_oom():
                    # what shares the Gaussians out takes the moments of its own from wherever all of them lie
                    given = (self.params, self.optimizers, self.state, self.config.batch_size == 1)
                    self.params, self.optimizers = moved_to(self._engine.device, *given)
            config, size, done = self.config, self.config.batch_size, self.step
            # views of steps that were taken are not known any more
            seen = [0] * size * done + self._order.ahead(size * (config.max_steps - done))
            seen = coarse_to_fine(self._train, seen, config.coarse_stop_iters, size)
            given = (config, self.strategy, *seen, self.updates, done, self.appearance, self._ranks)
            self._stepper = self._engine.make_stepper(Task(*given, self._stop, self._scene_scale))
            with translate_oom():
                self._stepper.rebind(self.params, self.optimizers, self.state)
        return self._stepper

    def _log(self, segment: Segment, bar: tqdm) -> None:
        """Write the records of a segment."""
        for step in range(segment.first, self.step):
            lr_means = float(self.updates.rates[step, KEYS.index("means")])
            record = record_of(segment, step, self.config, lr_means, self._times.train)
            if record is not None and self._ranks.writes:
                self._results.log(record)
                self._latest = f", PSNR {record['psnr']:.2f}"
                bar.set_postfix_str(f"PSNR {record['psnr']:.2f}, N {record['num_gaussians']:,}", refresh=False)
        self._times.add(segment.seconds, segment.seconds_cpu)
        bar.update(self.step - segment.first)

    def _milestones(self, step: int) -> None:
        """After a step (counted from 0): do what is due, a checkpoint last."""
        config, taken = self.config, step + 1
        last = taken == config.max_steps
        # the checkpoint comes last: a run that is killed in between does this step's milestones again
        due = config.checkpoint_every > 0 and taken % config.checkpoint_every == 0
        saves = due or taken in config.save_steps or last
        try:
            if self._ranks.writes:
                self._write_milestones(step, last)
        except Abandoned:
            self._save()
            raise
        if saves:
            self._save()

    def _write_milestones(self, step: int, last: bool) -> None:
        """Keep histograms, write the PLY, measure."""
        config, taken = self.config, step + 1
        if taken == config.strategy.blur_stop_iter or last:
            self._results.write_opacities(step, self._opacities().numpy())
        if self.appearance.params and (taken in config.save_steps or last):
            self._results.write_stats("appearance", step, self.appearance.by_view(self._train))
        if taken in config.save_steps or last:
            path = self._results.path / "ply" / f"point_cloud_{step}.ply"
            frame = Frame.of_training(self._capture.world_transform if config.normalize else None, config.drawn)
            save_ply(path, self._detached(), config.antialiased, frame=frame)
        # last, as it may be left half way
        if taken in config.eval_steps or last:
            self._evaluate(step)

    def _evaluate(self, step: int) -> dict[str, Any]:
        self._require_finite()
        config, strategy = self.config, self.strategy
        stats = {
            "step": step,
            **({"method": strategy.name} if isinstance(strategy, ForeignStrategy) else facts(config, self._train)),
            "capture": self._capture.name,
            **population(self._opacities()),
            **self._facts(),
        }
        self._results.write_stats("train", step, {**stats, "ellipse_time": self._times.train})
        folder = self._results if step + 1 == config.max_steps else None
        given = (self._engine.backend, self.params, self._test, config, self.sh_degree(step), self._nets)
        with self._stop.abandoning(self._ranks.size == 1):
            stats |= evaluate(*given, folder, step)
        stats["seconds_total"] = self._times.total
        self._results.write_stats("val", step, stats)
        return stats

    def _facts(self) -> dict[str, Any]:
        engine, stepper = self._engine, self.stepper
        names = {**run_facts(engine.backend.name, self._times.train, self._times.total), "stepper": stepper.name}
        return {**names, **self._times.facts(engine.device.type == "cpu"), **engine.facts(), **stepper.facts()}

    def _save(self) -> None:
        """Write a checkpoint, if this is the process that writes and all hold the same."""
        self.stepper.synchronize()
        self._ranks.require_same(self._detached(), self.step)
        self.stepper.gather()
        self._require_finite()
        optimizers = self.stepper.moments()
        if not self._ranks.writes:
            return
        content = {
            "step": self.step - 1,
            "splats": self._detached(),
            "optimizers": optimizers,
            "strategy": on_cpu(ckpt.pack_strategy(self.state)),
            "view_order": self._order.state_dict(),
            "appearance": self.appearance.state_dict(),
            "config": self.config.binding(),
            "capture": self._fingerprint,
            "metrics_bytes": self._results.flush_metrics(),
            "seconds": self._times.state_dict(),
            "threads": torch.get_num_threads(),
            "versions": versions(),
        }
        ckpt.save_checkpoint(ckpt.checkpoint_path(self._results.path, self.step - 1), content)
        milestones = {step - 1 for step in self.config.save_steps}
        ckpt.prune_checkpoints(self._results.path, self.config.keep_checkpoints, milestones)

    def _restore(self, path: Path) -> None:
        content = ckpt.load_checkpoint(path, self.params)
        threads = torch.get_num_threads() if self._engine.depends_on_threads else None
        given = (self.config, self._fingerprint, threads, len(self._train), self.state.keys())
        ckpt.check_fits(path, content, *given)
        self.params = {key: Parameter(content["splats"][key]) for key in KEYS}
        self.optimizers = make_optimizers(self.params, content["optimizers"])
        ckpt.unpack_strategy(self.state, content["strategy"])
        self._order.load_state_dict(content["view_order"])
        self.appearance.load_state_dict(content["appearance"])
        if self._ranks.writes:
            self._results.open_metrics(content["metrics_bytes"])
        self._times.load_state_dict(content["seconds"])
        self.step = content["step"] + 1
        self._stepper = None

    @property
    def backend(self) -> Any:
        """What measures and draws the run's Gaussians, wherever they lie."""
        return self._engine.backend

    def sh_degree(self, step: int) -> int:
        """Return the highest colour band that a step, from 0, draws."""
        config = self.config
        return active_sh_degree(step, config.sh_interval, config.sh_degree, config.strategy.sh_start_iter)

    @cached_property
    def _fingerprint(self) -> dict[str, str]:
        return ckpt.capture_fingerprint(self._capture, self.config)

    def _detached(self) -> dict[str, Tensor]:
        return {key: value.detach().cpu() for key, value in self.params.items()}

    def _opacities(self) -> Tensor:
        return opacities_from_logits(self.params["opacities"].detach().cpu())

    @property
    def _what_is_left(self) -> str:
        if self._unwritten is not None:
            return "nothing was written"
        return f"{'the latest' if ckpt.list_checkpoints(self._results.path) else 'no'} checkpoint is kept"

    def _require_finite(self) -> None:
        require_usable(self._detached(), f"after {self.step} steps; {self._what_is_left}")
