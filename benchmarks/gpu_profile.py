"""The time that a call's kernels take on the GPU, summed by the profiler: what is left when Python and waiting are not.

Wall times hold value checks, waits of the host and Python's own time; the sums of two implementations compare kernels.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, Final

import torch

LARGEST: Final = 12  # kernels that are listed by name
# waits that the benchmark itself puts before a step
_OURS = ("spin_kernel", "sleep")


def kernel_sums(run: Callable[[], Any], calls: int = 10) -> dict[str, Any]:
    """Run a few times under the profiler.

    Returns:
        `kernels_ms`: the sum of a call's kernels, copies and fills; `launches` of a call; `largest`: ms of a call by
        kernel's name, the largest first. Where the profiler saw nothing, or cannot work here, `skipped` alone.
    """
    run()
    torch.cuda.synchronize()
    try:
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
            for _ in range(calls):
                run()
            torch.cuda.synchronize()
        events = list(profile.events() or [])
    # wall times are not lost to a profiler that is not allowed on a machine
    except (RuntimeError, AssertionError) as error:
        return {"skipped": f"the profiler cannot work here: {error}"}
    return summed(events, calls)


def summed(events: Iterable[Any], calls: int) -> dict[str, Any]:
    """Add up the profiler's events of the GPU; a region's name spans kernels that are counted already."""
    times: Counter[str] = Counter()
    launches = 0
    for event in events:
        on_gpu = event.device_type == torch.autograd.DeviceType.CUDA
        if not on_gpu or getattr(event, "is_user_annotation", False) or any(name in event.name for name in _OURS):
            continue
        times[event.name] += event.time_range.elapsed_us() / 1e3 / calls
        launches += 1
    if not launches:
        return {"skipped": "the profiler saw no kernels"}
    largest = {name[:80]: ms for name, ms in times.most_common(LARGEST)}
    return {"kernels_ms": sum(times.values()), "launches": launches / calls, "largest": largest}
