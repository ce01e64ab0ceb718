"""Steps that run ahead of the host: one CUDA graph for a step, and flags that are read some steps late."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def captured(launch: Callable[[], None], device: torch.device) -> Callable[[], None]:
    """Capture what `launch` asks of the GPU, and return what does it again.

    Nothing is executed while capturing, so everything that loads or allocates at its first use must have run before.
    """
    here, aside = torch.cuda.current_stream(device), torch.cuda.Stream(device)
    graph = torch.cuda.CUDAGraph()
    aside.wait_stream(here)
    # not `torch.cuda.graph`: it empties the cache of memory, which the next density event would have to fill again
    with torch.cuda.stream(aside):
        # other threads, a progress bar's for one, may go on calling CUDA
        graph.capture_begin(capture_error_mode="thread_local")
        try:
            launch()
        finally:
            graph.capture_end()
    here.wait_stream(aside)
    return graph.replay


class Watch:
    """Copies of the device's flags, posted after every step and read some steps later.

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
        """Ask for the flags as they will be when everything asked of the GPU so far is done."""
        k = (self._first + self._posted) % len(self._copies)
        self._copies[k].copy_(self._state, non_blocking=True)
        self._events[k].record()
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
