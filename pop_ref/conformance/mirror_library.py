"""The host mirror of the CUDA kernels as Python: arrays in, arrays out, in either precision."""

from __future__ import annotations

import ctypes
import importlib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pop_ref.constants import PAPER, Profile

N_ARRAYS = 12
_NUMBERS = (
    "near_plane",
    "far_plane",
    "eps2d",
    "frustum_margin",
    "extent_sigmas",
    "alpha_floor",
    "alpha_ceiling",
    "transmittance_stop",
)
_SWITCHES = ("near_inclusive", "centred", "inria_clamp", "square", "pass_ceiling", "stop_inclusive")


def _structs(real: Any) -> tuple[Any, Any]:
    class CProfile(ctypes.Structure):
        _fields_ = [
            *((name, real) for name in _NUMBERS),
            ("tile_size", ctypes.c_int),
            *((name, ctypes.c_bool) for name in _SWITCHES),
        ]

    class CArguments(ctypes.Structure):
        _fields_ = [
            ("inputs", ctypes.c_void_p * N_ARRAYS),
            ("outputs", ctypes.c_void_p * N_ARRAYS),
            ("ids", ctypes.c_void_p * N_ARRAYS),
            ("n", ctypes.c_longlong),
            ("integers", ctypes.c_int * N_ARRAYS),
            ("numbers", real * N_ARRAYS),
            ("profile", CProfile),
        ]

    return CProfile, CArguments


@cache
def library(folder: Path) -> ctypes.CDLL:
    """Build the mirror if it is not there yet, and load it."""
    return ctypes.CDLL(str(importlib.import_module("cuda_ext.host.mirror").build_mirror(folder)))


class Mirror:
    """The mirror in one precision.

    Args:
        folder: where the library is built.
        dtype: numpy.float32 or numpy.float64.
    """

    def __init__(self, folder: Path, dtype: Any) -> None:
        self.dtype = dtype
        real = ctypes.c_float if dtype == np.float32 else ctypes.c_double
        self._profile_struct, self._arguments_struct = _structs(real)
        entry = library(folder)
        self._call = entry.pop_mirror_f32 if dtype == np.float32 else entry.pop_mirror_f64

    def call(
        self,
        name: str,
        n: int,
        inputs: list[Any],
        shapes: list[tuple[int, ...]],
        id_shapes: list[tuple[int, ...]] | None = None,
        ids: list[Any] | None = None,
        integers: tuple[int, ...] = (),
        numbers: tuple[float, ...] = (),
        profile: Profile = PAPER,
    ) -> list[np.ndarray]:
        """Run one entry of the mirror.

        Args:
            name: the entry.
            n: rows.
            inputs: arrays of real numbers.
            shapes: of the real outputs.
            id_shapes: of the integer outputs.
            ids: integer inputs, behind the integer outputs.
            integers: small integers.
            numbers: small real numbers.
            profile: the constants.

        Returns:
            The real outputs as float64, then the integer outputs as int64.
        """
        reals = [np.ascontiguousarray(a, dtype=self.dtype) for a in inputs]
        outputs = [np.zeros(shape, dtype=self.dtype) for shape in shapes]
        id_outputs = [np.zeros(shape, dtype=np.int64) for shape in id_shapes or []]
        id_inputs = [np.ascontiguousarray(a, dtype=np.int64) for a in ids or []]
        arguments = self._arguments_struct(n=n, profile=self._profile(profile))
        for slot, arrays in (("inputs", reals), ("outputs", outputs), ("ids", [*id_outputs, *id_inputs])):
            for k, array in enumerate(arrays):
                getattr(arguments, slot)[k] = array.ctypes.data
        for k, value in enumerate(integers):
            arguments.integers[k] = value
        for k, value in enumerate(numbers):
            arguments.numbers[k] = value
        if self._call(name.encode(), ctypes.byref(arguments)) != 0:
            raise LookupError(f"the mirror has no entry {name}")
        return [*(a.astype(np.float64) for a in outputs), *id_outputs]

    def _profile(self, profile: Profile) -> Any:
        return self._profile_struct(**profile.as_numbers())
