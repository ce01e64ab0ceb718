"""The whole training step in C++: from raw parameters to Adam's update, without a torch operation in between.

`NativeTrainer` takes steps on tensors that it updates in place, and collects what density control reads; it has the
interface of `cuda_ext.training.train_step.FusedTrainer`. Meaning: `pop_ref.training.train_step`; the order of work is
explained in `step.h`. Results are the same bits for any number of threads.
"""

from __future__ import annotations

import ctypes
import os
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeVar

import torch
from torch import Tensor

from pop_fast.compiled.library import (
    POINTER,
    PROJECTION_CONSTANTS,
    REAL,
    WHOLE,
    StepperFunctions,
    call_library,
    fields_of,
    stepper_functions,
    this_library,
)
from pop_fast.stages.blend import Stop, below
from pop_fast.stages.harmonics import check_bands
from pop_fast.stages.losses import REACH, Padding, border_of, check_size, kept_windows
from pop_fast.train.signals import Abandoned, StopRequest, heard
from pop_fast.train.steps import Collected, Phase, StepSettings, StepStats
from pop_ref.settings import BETAS, EPS, PARAMETERS

if TYPE_CHECKING:
    from pop_fast.train.appearance import Appearance
    from pop_fast.train.views import ViewTensors

Moved = tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Tensor]]


def adam_step(
    params: Mapping[str, Tensor],
    grads: Mapping[str, Tensor],
    m: Mapping[str, Tensor],
    v: Mapping[str, Tensor],
    step: int,
    lr: Mapping[str, float],
    betas: tuple[float, float] = BETAS,
) -> Moved:
    """See `pop_ref.optimizer.adam_step`; eps is that of a training."""
    x, first, second = ({key: value.clone().contiguous() for key, value in group.items()} for group in (params, m, v))
    for key in grads:
        _move(x[key], first[key], second[key], grads[key].contiguous(), step, lr[key], betas)
    return x, first, second


def adam_steps(params: Mapping[str, Tensor], grads: Sequence[Mapping[str, Tensor]], lr: Mapping[str, float]) -> Moved:
    """See `pop_ref.optimizer.adam_steps`: what waits is not touched, and the counter is that of the steps."""
    x = {key: value.clone().contiguous() for key, value in params.items()}
    m, v = ({key: torch.zeros_like(value) for key, value in x.items()} for _ in range(2))
    for step, given in enumerate(grads, 1):
        for key, gradient in given.items():
            _move(x[key], m[key], v[key], gradient.contiguous(), step, lr[key], BETAS)
    return x, m, v


def _move(x: Tensor, m: Tensor, v: Tensor, gradient: Tensor, step: int, lr: float, betas: tuple[float, float]) -> None:
    arrays = (tensor.data_ptr() for tensor in (x, m, v, gradient))
    this_library().adam(*arrays, x.numel(), step, lr, *betas, EPS)


# steps that are taken before Python is asked again: Ctrl-C, a progress bar
LONGEST: Final = 10
# the pixelwise losses that the step knows, by its number
LOSSES: Final = ("l2", "l1")
# of (Gaussian, tile) pairs of a step, which are numbered with 32 bits
MOST_ENTRIES: Final = 2**31 - 1
# what the step measures, the first of `StepStats`
N_VALUES: Final = 5
PARTS: Final = ("project", "list", "blend", "loss", "image_gradient", "transpose", "update")
# what a step had to do: `pop::StepCounts` of step.h, where each is explained, in its order
COUNTS: Final = ("visible", "entries", "walked", "chunks", "pairs", "marked", "reached")
T = TypeVar("T")


class StepGiven(ctypes.Structure):
    """`pop::StepGiven` of step.h, where every field is explained, in its order."""

    _fields_ = (
        *fields_of(POINTER * len(PARAMETERS), "params", "m", "v"),
        *fields_of(WHOLE, "n", "n_rest"),
        *fields_of(POINTER, "viewmat", "K", "target", "mu_y", "s_yy", "kept", "kept_windows"),
        *fields_of(WHOLE, "width", "height", "n_kept", "n_windows"),
        *fields_of(WHOLE, "near_inclusive", "centred", "inria_clamp", "square", "antialiased", "ceiling_passes"),
        *fields_of(REAL, "near_plane", "far_plane", "eps2d", "frustum_margin", "extent_sigmas", "alpha_floor"),
        *fields_of(REAL, "floor_below", "alpha_ceiling", "stop"),
        *fields_of(POINTER, "exposure", "samples"),
        *fields_of(WHOLE, "n_samples"),
        *fields_of(REAL * 3, "background"),
        *fields_of(WHOLE, "degree", "border", "l1"),
        *fields_of(REAL, "pixel_weight", "ssim_weight", "lambda_pop", "lambda_entropy"),
        *fields_of(REAL, "depth_weight", "opacity_reg", "scale_reg"),
        *fields_of(WHOLE, "dominance", "pop_window", "pop_visible", "blur_own_view"),
        *fields_of(REAL, "blur_pixels"),
        *fields_of(REAL * len(PARAMETERS), "lr"),
        *fields_of(REAL, "beta1", "beta2", "eps"),
        *fields_of(WHOLE, "most_entries"),
        *fields_of(WHOLE * len(PARAMETERS), "updates"),
        *fields_of(POINTER, "sh_rest_sum"),
        *fields_of(POINTER, "grad_sum", "n_visible", "dominant_sum", "blurred"),
        *fields_of(POINTER, "v_exposure", "values", "seconds", "bad_row"),
    )


@dataclass(frozen=True)
class _Target:
    """A view as the step takes it: planes of channels, float32."""

    viewmat: Tensor
    K: Tensor
    target: Tensor
    mu_y: Tensor
    s_yy: Tensor
    kept: Tensor | None
    kept_windows: Tensor | None
    # where its sparse points lie, px, and their disparities. [M, 3]
    samples: Tensor | None

    @classmethod
    def of(cls, view: ViewTensors, padding: Padding, with_depth: bool) -> _Target:
        height, width = view.photo.shape[:2]
        check_size(view.photo, padding)
        border = border_of(padding)
        target = torch.empty((3, height, width))
        mu_y, s_yy = (torch.empty((3, height + 2 * border - REACH, width + 2 * border - REACH)) for _ in range(2))
        numbers = {"height": height, "width": width, "border": border, "threads": torch.get_num_threads()}
        tensors = {"photograph": view.photo, "target": target, "mu_y": mu_y, "s_yy": s_yy}
        call_library("moments", torch.float32, numbers, tensors)
        mask = view.mask
        found = view.depth_samples() if with_depth else None
        return cls(
            view.viewmat.reshape(4, 4).float().contiguous(),
            view.K.reshape(3, 3).float().contiguous(),
            target,
            mu_y,
            s_yy,
            None if mask is None else mask.contiguous(),
            None if mask is None else kept_windows(mask, padding, 1, torch.float32).contiguous(),
            None if found is None else torch.cat((found[0], found[1][:, None]), 1).float().contiguous(),
        )

    @property
    def bytes(self) -> int:
        """Memory of what was made of the photograph."""
        return sum(maps.numel() * maps.element_size() for maps in (self.target, self.mu_y, self.s_yy))


def _close(functions: StepperFunctions, stepper: int, owner: int) -> None:
    # a fork of the process that made it has none of its threads, and would wait for them without end
    if os.getpid() == owner:
        functions.close(stepper)


class NativeTrainer:
    """Takes training steps on CPU tensors.

    Args:
        params: raw float32 tensors by gsplat's keys, updated in place.
        m, v: Adam's moments, likewise.
        threads: None takes torch's number.
        cache_mb: memory for what is made of photographs; the others' is made anew at every visit, to the same bits.
        stop: whether a stop was requested; a step that is being taken is then left, and changes nothing.
        exposures: of the photographs, which learn with every step; None where none are learned.
    """

    def __init__(
        self,
        params: Mapping[str, Tensor],
        m: Mapping[str, Tensor],
        v: Mapping[str, Tensor],
        views: Sequence[ViewTensors],
        order: Sequence[int],
        settings: StepSettings,
        step: int = 0,
        *,
        threads: int | None = None,
        cache_mb: float = 1024,
        stop: StopRequest | None = None,
        exposures: Appearance | None = None,
    ) -> None:
        self.settings, self.step = settings, step
        self._stop, self._alone = stop or StopRequest(), stop is None
        self._padding: Padding = settings.padding
        self._exposures = exposures
        self._views, self._order = views, list(order)
        self._targets: dict[int, _Target] = {}
        self._cache_left = cache_mb * 2**20
        self._functions = stepper_functions(ctypes.sizeof(StepGiven))
        stepper = self._functions.open(torch.get_num_threads() if threads is None else threads)
        if stepper is None:
            raise MemoryError("there is no memory for the native training step")
        self._stepper = stepper
        weakref.finalize(self, _close, self._functions, self._stepper, os.getpid())
        self._given = StepGiven()
        self._seconds = torch.zeros(len(PARTS), dtype=torch.float64)
        self._v_exposure = torch.zeros((3, 4), dtype=torch.float64)
        self._bad_row = torch.full((1,), -1, dtype=torch.int64)
        self._history: dict[int, StepStats] = {}
        self._describe()
        self.rebind(params, m, v)

    def rebind(self, params: Mapping[str, Tensor], m: Mapping[str, Tensor], v: Mapping[str, Tensor]) -> None:
        """Take new rows after a densification step; statistics start from nothing.

        Raises:
            ValueError: a tensor is not float32, not contiguous, or not on the CPU.
        """
        given, n = self._given, len(params["means"])
        for name, group in (("params", params), ("m", m), ("v", v)):
            for k, key in enumerate(PARAMETERS):
                tensor = group[key]
                if tensor.dtype != torch.float32 or not tensor.is_contiguous() or tensor.device.type != "cpu":
                    raise ValueError(f"{name}[{key!r}] must be a contiguous float32 tensor on the CPU")
                getattr(given, name)[k] = tensor.data_ptr()
        # the arguments only point
        self._rows = (dict(params), dict(m), dict(v))
        given.n, given.n_rest = n, params["shN"].shape[1]
        waits = self.settings.updates.sh_rest_every > 1
        self.statistics = Collected.zeros(n, torch.device("cpu"), given.n_rest if waits else None)
        found = self.statistics.sh_rest_sum
        given.sh_rest_sum = None if found is None else found.data_ptr()

    @property
    def params(self) -> Mapping[str, Tensor]:
        """Raw parameters by gsplat's keys."""
        return self._rows[0]

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds that each part of the steps took so far."""
        return dict(zip(PARTS, self._seconds.tolist(), strict=True))

    @property
    def bytes(self) -> int:
        """Memory that a step works in, the parameters and photographs not counted."""
        return self._functions.bytes(self._stepper)

    def counts(self) -> dict[str, int]:
        """Count what the last step had to do, by the names of `COUNTS`; all are 0 before the first."""
        found = (WHOLE * len(COUNTS))()
        self._functions.counts(self._stepper, found)
        return dict(zip(COUNTS, found, strict=True))

    def traced(self, until: int, phase: Phase) -> Tensor:
        """Take steps as `run` does, all parts of their works by this thread alone, and return what each took.

        The parts are cut as they are for all threads, so that one machine tells what a larger one has to share out.

        Returns:
            In order: 0 and the seconds that one thread has for itself before a work, or 1 and those of a part of it.
            The first 2**20 of them. [n, 2] float64
        """
        pairs = torch.zeros((1 << 20, 2), dtype=torch.float64)
        self._functions.trace(self._stepper, pairs.data_ptr(), len(pairs))
        try:
            self.run(until, phase)
        finally:
            n = self._functions.trace(self._stepper, None, 0)
        return pairs[:n].clone()

    def run(self, until: int, phase: Phase) -> None:
        """Take steps until the counter stands at `until`, all of one phase, or until a stop was requested.

        Raises:
            ValueError: a Gaussian is no longer finite; the message names its row and step. Or the phase's degree has
                more coefficients than the Gaussians.
            MemoryError: there is not enough, or the Gaussians reach more tiles than can be numbered.
        """
        self._history = {}
        self._set_phase(phase)
        # exposures move between two steps
        longest = LONGEST if self._exposures is None else 1
        while self.step < until and not self._asked:
            self._take(min(until - self.step, longest))

    @property
    def _asked(self) -> bool:
        return self._stop.asked

    def _called(self, function: Callable[..., T], *given: Any) -> T:
        """Call what may take seconds, so that a request to stop is heard meanwhile where there can be one."""
        return function(*given) if self._alone else heard(function, *given)

    def step_stats(self, first: int, last: int) -> list[StepStats]:
        """Return the measurements of the steps from `first` to before `last`; the last `run` must have taken them."""
        return [self._history[step] for step in range(first, last)]

    def synchronize(self) -> None:
        """Do nothing: no other process moves anything."""

    def facts(self) -> dict[str, int]:
        """Return nothing: what is too small grows before a step writes to it, and memory is the machine's."""
        return {}

    def _describe(self) -> None:
        """Set what stays the same over a run."""
        given, settings, profile = self._given, self.settings, self.settings.profile
        constants = profile.as_numbers()
        for name in (*PROJECTION_CONSTANTS, "alpha_ceiling"):
            setattr(given, name, constants[name])
        given.antialiased = settings.antialiased
        given.ceiling_passes = constants["pass_ceiling"]
        given.floor_below = below(profile.alpha_floor, torch.float32)
        given.stop = Stop.of(profile, torch.float32).at
        given.background = (REAL * 3)(*settings.background)
        given.border = border_of(self._padding)
        given.pop_visible, given.pop_window = settings.pop_over == "visible", settings.pop_views == "window"
        given.blur_own_view = settings.blur_window == "own_view"
        (given.beta1, given.beta2), given.eps = settings.updates.betas, settings.eps
        given.depth_weight = settings.depth_weight
        given.opacity_reg, given.scale_reg = settings.opacity_reg, settings.scale_reg
        given.most_entries = MOST_ENTRIES
        given.seconds = self._seconds.data_ptr()
        given.bad_row = self._bad_row.data_ptr()
        given.v_exposure = self._v_exposure.data_ptr()

    def _set_phase(self, phase: Phase) -> None:
        given, settings, found = self._given, self.settings, self.statistics
        check_bands(1 + given.n_rest, phase.sh_degree)
        given.degree, given.l1 = phase.sh_degree, LOSSES.index(phase.objective.pixelwise)
        given.pixel_weight, given.ssim_weight = phase.objective.weights
        given.lambda_pop = settings.lambda_pop if phase.pop else 0.0
        given.lambda_entropy = settings.lambda_entropy if phase.entropy else 0.0
        given.dominance = phase.dominance
        summed = phase.window or (phase.blur and settings.blur_window == "sum")
        blurs = phase.blur and settings.blur_window != "sum"
        given.grad_sum = found.grad_sum.data_ptr() if phase.statistics else None
        given.n_visible = found.n_visible.data_ptr() if phase.statistics else None
        given.dominant_sum = found.dominant_sum.data_ptr() if summed else None
        given.blurred = found.blurred.data_ptr() if blurs else None

    def _take(self, n: int) -> None:
        values = torch.zeros((n, N_VALUES), dtype=torch.float64)
        # held until the steps have been taken: the arguments only point
        try:
            with self._stop.abandoning():
                views = [self._target(self._order[step]) for step in range(self.step, self.step + n)]
        except Abandoned:
            return
        steps = (StepGiven * n)()
        for k, view in enumerate(views):
            self._set_step(self.step + k, view)
            self._given.values = values[k].data_ptr()
            steps[k] = self._given
        taken = self._called(self._functions.steps, self._stepper, steps, n, self._stop.address)
        if taken < 0:
            raise MemoryError("the native training step ran out of memory")
        for k in range(taken):
            self._history[self.step + k] = StepStats(*values[k].tolist())
        if self._exposures is not None and taken > 0:
            self._exposures.pull_exposure(self._order[self.step], self._v_exposure)
            self._exposures.update(self.step)
        self.step += taken
        if int(self._bad_row) >= 0:
            raise ValueError(f"step {self.step}: Gaussian {int(self._bad_row)} has a value that is not finite")
        if taken < n and not self._asked:
            raise MemoryError(
                f"step {self.step}: the Gaussians reach more than {MOST_ENTRIES:,} tiles altogether; "
                "train on smaller photographs (--factor), or bound the number of Gaussians"
            )

    def _set_step(self, step: int, view: _Target) -> None:
        given, settings = self._given, self.settings
        for name in ("viewmat", "K", "target", "mu_y", "s_yy"):
            setattr(given, name, getattr(view, name).data_ptr())
        given.height, given.width = view.target.shape[1:]
        given.kept = None if view.kept is None else view.kept.data_ptr()
        given.kept_windows = None if view.kept_windows is None else view.kept_windows.data_ptr()
        given.n_kept = given.width * given.height if view.kept is None else int(view.kept.sum())
        given.n_windows = view.mu_y[0].numel() if view.kept_windows is None else int(view.kept_windows.sum())
        given.samples = None if view.samples is None else view.samples.data_ptr()
        given.n_samples = 0 if view.samples is None else len(view.samples)
        if self._exposures is not None:
            # a row of what the exposures are kept in
            given.exposure = self._exposures.exposure(self._order[step]).data_ptr()
        given.blur_pixels = settings.blur_pixels(given.n_kept)
        rates, numbers = settings.updates.rates, settings.updates.numbers
        given.lr = (REAL * len(PARAMETERS))(*rates[step].tolist())
        given.updates = (WHOLE * len(PARAMETERS))(*numbers[step].tolist())

    def _target(self, index: int) -> _Target:
        if index in self._targets:
            return self._targets[index]
        made = self._called(_Target.of, self._views[index], self._padding, self.settings.depth_weight != 0.0)
        if made.bytes <= self._cache_left:
            self._cache_left -= made.bytes
            self._targets[index] = made
        return made
