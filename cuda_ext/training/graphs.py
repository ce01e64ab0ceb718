"""Steps that run ahead of the host: one CUDA graph for a step, and flags that are read some steps late."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


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
