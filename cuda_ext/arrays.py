"""Tensors to the kernels' pointers: checks, allocation with words when it fails, the profile, the device's state."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import torch
from torch import Tensor

from cuda_ext import load
from pop_ref.constants import Profile

NOT_BAD = 2**31 - 1
# places in DeviceState (csrc/launch.h)
OVERFLOW, N_INSTANCES, N_BUCKETS, N_IMPORTANT, BAD_ROW, STEP, VIEW, N_OTHERS = range(8)


class CudaMemoryError(RuntimeError):
    """The GPU has no room; the message says how much was asked for and what to lower."""


def on_gpu(tensor: Tensor) -> bool:
    """Tell whether kernels can read a tensor."""
    return tensor.device.type == "cuda"


def check_tensor(name: str, tensor: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return a float32 tensor of that shape that kernels can read.

    Raises:
        ValueError: names the tensor and what to do.
    """
    if not on_gpu(tensor):
        raise ValueError(f"{name} is on {tensor.device}; backend 'cuda' needs it on the GPU: use {name}.cuda()")
    if tensor.dtype != torch.float32:
        raise ValueError(f"{name} has dtype {tensor.dtype}; backend 'cuda' computes in float32: use {name}.float()")
    if tuple(tensor.shape) != shape:
        raise ValueError(f"{name} has shape {list(tensor.shape)}; it must be {list(shape)}")
    return tensor


def pointer(name: str, tensor: Tensor | None, dtypes: str = "float32") -> int:
    """Return a tensor's address, 0 for None.

    Args:
        name: what an error calls it.
        tensor: whose address.
        dtypes: names of the types that the kernels read there, between spaces.

    Raises:
        ValueError: it is not a contiguous CUDA tensor of such a type.
    """
    if tensor is None:
        return 0
    if not on_gpu(tensor):
        raise ValueError(f"{name} is on {tensor.device}; backend 'cuda' needs it on the GPU: use {name}.cuda()")
    if not _is_one_of(tensor.dtype, dtypes):
        raise ValueError(
            f"{name} has dtype {_named(tensor.dtype)}; the kernels read {' or '.join(dtypes.split())} there: "
            f"use {name}.to(torch.{dtypes.split()[-1]})"
        )
    if not tensor.is_contiguous():
        raise ValueError(f"{name} is not contiguous; use {name}.contiguous()")
    return tensor.data_ptr()


def _named(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


@cache
def _is_one_of(dtype: torch.dtype, names: str) -> bool:
    return _named(dtype) in names.split()


def fill(struct: Any, **fields: Any) -> Any:
    """Set a struct's fields, tensors by address and numbers as they are, and return it.

    The struct keeps the tensors: an address is no use when its memory has been handed to somebody else.

    Raises:
        ValueError: a tensor is not what the kernels read there; see `pointer`.
        TypeError: the struct has no such field, or it is a number's and a tensor was given.
    """
    kind = type(struct)
    dtypes, kept = getattr(kind, "dtypes", {}), struct.__dict__.setdefault("kept", {})
    for name, value in fields.items():
        if name in dtypes:
            setattr(struct, name, pointer(name, value, dtypes[name]))
            kept[name] = value
        elif not hasattr(kind, name):
            # without this check the name would become an attribute that no kernel reads
            raise TypeError(f"{kind.__name__} has no field {name}; it has {', '.join(_fields(kind))}")
        elif isinstance(value, Tensor):
            raise TypeError(f"{kind.__name__}.{name} is a number, not a tensor")
        else:
            setattr(struct, name, value)
    return struct


def _fields(kind: Any) -> list[str]:
    return [name for name in dir(kind) if not name.startswith(("_", "set_")) and name != "dtypes"]


def empty(
    what: str, lower: str, shape: tuple[int, ...], device: torch.device, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Allocate, or say what was asked for and what to lower.

    Raises:
        CudaMemoryError: the GPU has no room.
    """
    try:
        return torch.empty(shape, dtype=dtype, device=device)
    except torch.cuda.OutOfMemoryError as error:
        asked = dtype.itemsize
        for size in shape:
            asked *= size
        free, total = torch.cuda.mem_get_info(device)
        raise CudaMemoryError(
            f"the GPU has no room for {what}: {asked / 1e6:.0f} MB asked for, {free / 1e6:.0f} of "
            f"{total / 1e6:.0f} MB free; lower {lower}"
        ) from error


def stream_of(device: torch.device) -> int:
    """Return the address of torch's current stream, on which every kernel runs."""
    return torch.cuda.current_stream(device).cuda_stream


class SideStream:
    """A stream parallel to the current one, for kernels that need nothing of each other.

    Args:
        device: where.
        used: False, or a device without streams: all kernels are asked for in turn.
    """

    def __init__(self, device: torch.device, used: bool = True) -> None:
        self._device = device
        self._stream = torch.cuda.Stream(device) if used and device.type == "cuda" else None

    @contextmanager
    def beside(self) -> Iterator[None]:
        """Run what follows in parallel with the current stream's next work, after its earlier work."""
        if self._stream is None:
            yield
            return
        self._stream.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(self._stream):
            yield

    def join(self) -> None:
        """Let the current stream wait for what was asked for in parallel."""
        if self._stream is not None:
            torch.cuda.current_stream(self._device).wait_stream(self._stream)


def new_state(device: torch.device) -> Tensor:
    """Make a device state: nothing overflowed, no bad row, step 0."""
    state = torch.zeros(load().STATE_INTS, dtype=torch.int32, device=device)
    state[BAD_ROW] = NOT_BAD
    return state


def kernel_profile(profile: Profile, tile_size: int) -> Any:
    """Return the kernels' form of a profile, to be read only: it is one for all who ask."""
    return _kernel_profile(load(), profile, tile_size)


@lru_cache(maxsize=64)
def _kernel_profile(kernels: Any, profile: Profile, tile_size: int) -> Any:
    made = kernels.Profile()
    for name, value in {**profile.as_numbers(), "tile_size": tile_size}.items():
        setattr(made, name, value)
    return made


@dataclass(frozen=True)
class Settings:
    """What a render depends on besides tensors."""

    # px
    width: int
    height: int
    profile: Profile  # constants
    tile_size: int  # px, the caller's
    sh_degree: int | None = None  # bands, None for given colours
    antialiased: bool = False  # scale opacities by the low-pass compensation
    radius_clip: float = 0.0  # px
    absgrad: bool = False  # also sum |v_means2d|
    backward: str = "pixel_parallel"  # "pixel_parallel" or "gaussian_parallel", which kernel goes back
    deterministic: bool = True  # sum gradients through slots; False adds atomically and saves 48 bytes an instance

    def kernel_profile(self) -> Any:
        """Return the kernels' form of the profile."""
        return kernel_profile(self.profile, self.tile_size)

    def project_settings(self) -> Any:
        """Return what the projection kernels take."""
        made = load().ProjectSettings()
        made.profile = self.kernel_profile()
        made.sh_degree = self.sh_degree or 0
        made.antialiased = self.antialiased
        made.radius_clip = self.radius_clip
        return made
