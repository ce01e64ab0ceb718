"""The fused training step: photographs resident as bytes, one CUDA graph a step, no host synchronisation in the loop.

`FusedTrainer.run(until)` replays begin -> project -> list -> blend -> loss -> blend back -> update -> end. The device
holds the step counter, picks the view, makes the learning rates and keeps what every step tells, so that one graph
serves all steps of a kind. Steps run ahead of the host: when instances do not fit, the device raises a flag and does
nothing from that step on; the host sees the flag two steps late, grows the buffers and continues from the device's
counter: nothing is cut or lost. Everything is asked of the tensors' device, whatever device is current.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from cuda_ext.arrays import BAD_ROW, N_INSTANCES, NOT_BAD, OVERFLOW, STEP, VIEW
from cuda_ext.render.lists import Capacity, Size, TileBuffers
from cuda_ext.training.step_buffers import FrameBuffers, KernelStatistics, ResidentViews, RowBuffers, Shared
from cuda_ext.training.step_program import StepProgram

if TYPE_CHECKING:
    from pop_fast.train.steps import Phase, StepSettings

LATE = 2  # steps between an overflow and its notice


@dataclass
class _Kind:
    """Steps of one image size and one phase: how they are launched and, once they have come again, replayed."""

    program: StepProgram
    replay: Callable[[], None] | None = None


class FusedTrainer:
    """Owns the device's side of training between two densification steps.

    Args:
        params: raw float32 CUDA tensors by gsplat's keys; updated in place.
        m, v: Adam's moments, likewise.
        views: the resident photographs and cameras.
        order: the view of every step of the schedule.
        settings: objective and update.
        step: the step to begin at.

    Attributes:
        grown: how often a step had to be taken again because its instances did not fit.
    """

    def __init__(
        self,
        params: Mapping[str, Tensor],
        m: Mapping[str, Tensor],
        v: Mapping[str, Tensor],
        views: ResidentViews,
        order: Sequence[int],
        settings: StepSettings,
        step: int = 0,
    ) -> None:
        self.settings, self.views, self.step, self.grown = settings, views, step, 0
        self.device = params["means"].device
        self._order = list(order)
        self._capacity = Capacity(views.sizes)
        with torch.cuda.device_of(params["means"]):
            self._shared = Shared.make(settings, views, self._order, step, self.device)
            self._watch = Watch(self._shared.state, LATE + 1)
        self.rebind(params, m, v)

    def rebind(self, params: Mapping[str, Tensor], m: Mapping[str, Tensor], v: Mapping[str, Tensor]) -> None:
        """Take new rows after a densification step: buffers, statistics and graphs start anew."""
        # what the old number of Gaussians needed goes first, so that old and new need not fit side by side
        self._kinds: dict[tuple[Size, Phase], _Kind] = {}
        self._frames: dict[Size, FrameBuffers] = {}
        self._rows = None
        self._capacity.settle(len(params["means"]))
        with torch.cuda.device_of(params["means"]):
            waits = params["shN"].shape[1] if self.settings.updates.sh_rest_every > 1 else None
            self._rows = RowBuffers.make(params, m, v, KernelStatistics.zeros(len(params["means"]), self.device, waits))

    def run(self, until: int, phase: Phase) -> None:
        """Take steps until the counter stands at `until`, all of one phase.

        Raises:
            ValueError: a Gaussian is no longer finite; the message names its row and step. Or the phase's degree has
                more coefficients than the Gaussians.
            CudaMemoryError: no room to grow.
        """
        with torch.cuda.device_of(self._shared.state):
            self._run(until, phase)

    def _run(self, until: int, phase: Phase) -> None:
        watch = self._watch
        while self.step < until or watch:
            if self.step < until:
                view = self._order[self.step]
                self.views.fetch(view)
                self._take(self.views.sizes[view], phase)
                watch.post()
                self.step += 1
                if len(watch) <= LATE and self.step < until:
                    continue
            values = watch.take()
            if values[BAD_ROW] == NOT_BAD and values[OVERFLOW] == 0:
                self._capacity.note(values[VIEW], values[N_INSTANCES])
            else:
                self.step = self._recover()

    def step_stats(self, first: int, last: int) -> list[list[float]]:
        """Return the measurements of the steps from `first` to before `last`, which `run` must have taken here.

        They are in the order of csrc/train.h: pixelwise loss, SSIM, objective, square, POP term.
        """
        return self._shared.history[first:last].tolist()

    def synchronize(self) -> None:
        """Do nothing: no other process moves anything."""

    def facts(self) -> dict[str, int]:
        """Return how often buffers grew, and how the photographs lie."""
        return {"instance_buffers_grown": self.grown, **self.views.facts()}

    @property
    def n(self) -> int:
        """How many Gaussians there are."""
        return len(self._population)

    @property
    def params(self) -> Mapping[str, Tensor]:
        """Raw parameters by gsplat's keys."""
        return self._population.params

    @property
    def statistics(self) -> KernelStatistics:
        """What density control reads; zeros after `rebind`."""
        return self._population.statistics

    @property
    def values(self) -> Tensor:
        """The statistics of the last step, in the order of csrc/train.h."""
        return self._shared.values

    @property
    def n_instances(self) -> int:
        """How many list entries the last step had."""
        return int(self._shared.state[N_INSTANCES])

    @property
    def splats(self) -> Mapping[str, Tensor]:
        """What the last step drew, by the kernels' names."""
        return self._population.drawn.splats

    @property
    def radii(self) -> Tensor:
        """Extents of the last step's splats, px, 0 where culled. [N, 2] int32"""
        return self.splats["radii"]

    def lists(self) -> dict[Size, TileBuffers]:
        """Return the tile lists of the last step at every image size that was drawn since `rebind`."""
        return {size: frame.lists for size, frame in self._frames.items()}

    def render_stats(self) -> dict[Size, dict[str, Tensor]]:
        """Return, by image size, what the last step of a phase that asks for dominant Gaussians found at every pixel.

        How many splats it blended and visited is among it where `settings.counts` asked for that.
        """
        return {size: frame.render_stats for size, frame in self._frames.items()}

    @property
    def _population(self) -> RowBuffers:
        assert self._rows is not None
        return self._rows

    def _recover(self) -> int:
        """Handle what halted the device, and return the step to continue from."""
        state = self._shared.state
        # waits for all that was asked of the GPU: copies on their way, and graphs that use what goes now
        flags = state.tolist()
        self._watch.clear()
        if flags[BAD_ROW] != NOT_BAD:
            self.step = flags[STEP]
            raise ValueError(f"step {flags[STEP]}: Gaussian {flags[BAD_ROW]} has a value that is not finite")
        self.grown += 1
        size = self._capacity.overflowed(flags[VIEW], flags[OVERFLOW])
        self._kinds = {key: kind for key, kind in self._kinds.items() if key[0] != size}
        del self._frames[size]
        state[OVERFLOW] = 0
        return int(flags[STEP])

    def _take(self, size: Size, phase: Phase) -> None:
        kind = self._kinds.get((size, phase))
        if kind is None:
            # the first step of a kind is launched as it is, which loads its kernels
            kind = self._kinds[size, phase] = _Kind(
                StepProgram(self._shared, self._population, self._frame(size), phase)
            )
            kind.program.launch()
            return
        if not self.settings.replay:
            kind.program.launch()
            return
        # with many sizes most kinds come once between two densification steps, and a capture takes longer than a step
        if kind.replay is None:
            kind.replay = captured(kind.program.launch, self.device)
        kind.replay()

    def _frame(self, size: Size) -> FrameBuffers:
        if size not in self._frames:
            self._frames[size] = FrameBuffers.make(self._shared, self.n, size, self._capacity.room(size))
        return self._frames[size]


def captured(launch: Callable[[], None], device: torch.device) -> Callable[[], None]:
    """Capture what `launch` asks of the GPU, and return what does it again.

    Nothing is executed while capturing. `launch` must have run before with the same buffers, because a kernel's first
    launch loads its code, and the sorts choose theirs by the buffers' size; it must allocate nothing, wait for nothing,
    and ask for everything in the current stream. The graph keeps addresses, not tensors: whoever holds what is returned
    holds the tensors too.

    Raises:
        RuntimeError: the step cannot be captured; says how to do without.
    """
    here, aside = torch.cuda.current_stream(device), torch.cuda.Stream(device)
    graph = torch.cuda.CUDAGraph()
    # torch's default stream cannot be captured, and what it has still to do need not be finished: nothing runs here
    aside.wait_stream(here)
    # not `torch.cuda.graph`: it waits for the GPU and empties torch's cache of memory, and the next densification step
    # would have to ask the driver for all of it again
    try:
        with torch.cuda.stream(aside), _no_collection():
            # "global" would let a call of another thread, a progress bar's for one, end the capture
            graph.capture_begin(capture_error_mode="thread_local")
            try:
                launch()
            finally:
                # also after an error: until then every allocation of this thread belongs to the capture
                graph.capture_end()
    except RuntimeError as error:
        # of two errors the first one, which is the reason, and not the capture's that it broke
        reason = error.__context__ or error
        raise RuntimeError(
            f"a training step cannot be captured as a CUDA graph ({reason}); StepSettings(replay=False) does without"
        ) from error
    # the graph is replayed where steps are launched; what torch has put aside for it comes before
    here.wait_stream(aside)
    return graph.replay


@contextmanager
def _no_collection() -> Iterator[None]:
    """Keep Python's collector from freeing an older graph meanwhile, which CUDA does not allow while it captures."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


class Watch:
    """Copies of the device's flags, posted after every step and read some steps later.

    The copies lie in pinned memory, else a copy would make the host wait; a place is written again only after its last
    copy was taken, so that none is overwritten by the GPU while the host reads it.

    Args:
        state: the device's flags.
        depth: how many copies may be on their way.
    """

    def __init__(self, state: Tensor, depth: int) -> None:
        self._state = state
        self._copies = [torch.empty(state.shape, dtype=state.dtype, pin_memory=True) for _ in range(depth)]
        self._events = [torch.cuda.Event() for _ in range(depth)]
        self._first, self._posted = 0, 0

    def __len__(self) -> int:
        return self._posted

    def post(self) -> None:
        """Ask for the flags as they will be when everything asked of the GPU so far is done.

        Raises:
            RuntimeError: `depth` copies are on their way already.
        """
        if self._posted == len(self._copies):
            raise RuntimeError(f"{self._posted} copies of the flags are on their way; take one first")
        k = (self._first + self._posted) % len(self._copies)
        self._copies[k].copy_(self._state, non_blocking=True)
        # of the stream that the copy is in: the current one of the state's device, whatever device is current
        self._events[k].record(torch.cuda.current_stream(self._state.device))
        self._posted += 1

    def take(self) -> list[int]:
        """Wait for the oldest copy and return it."""
        k = self._first
        self._events[k].synchronize()
        self._first, self._posted = (k + 1) % len(self._copies), self._posted - 1
        return self._copies[k].tolist()

    def clear(self) -> None:
        """Forget what is on its way; the caller has waited for the GPU."""
        self._posted = 0
