"""What the kernels are handed: every pointer takes tensors of its own type alone, and no name is made up."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

import cuda_ext

EVERY_TYPE = ("float32", "float64", "float16", "int64", "int32", "int16", "uint8", "bool")


def structs():
    kernels = cuda_ext.load()
    found = [getattr(kernels, name) for name in dir(kernels)]
    return [kind for kind in found if isinstance(kind, type) and hasattr(kind, "dtypes")]


def test_every_pointer_of_the_kernels_structs_takes_its_own_type_and_no_other(gpu):
    from cuda_ext.arrays import fill

    fields = 0
    for kind in structs():
        for name, dtypes in kind.dtypes.items():
            fields += 1
            for dtype in EVERY_TYPE:
                tensor = torch.zeros(4, dtype=getattr(torch, dtype), device=gpu)
                if dtype in dtypes.split():
                    assert getattr(fill(kind(), **{name: tensor}), name) == tensor.data_ptr()
                    continue
                words = f"{name} has dtype {dtype}; the kernels read {dtypes.replace(' ', ' or ')} there"
                with pytest.raises(ValueError, match=re.escape(words)):
                    fill(kind(), **{name: tensor})
            assert getattr(fill(kind(), **{name: None}), name) == 0
    assert fields == pointers_in_the_bindings()


def pointers_in_the_bindings() -> int:
    folder = Path(cuda_ext.__file__).parent
    text = "".join((folder / name).read_text() for name in ("bindings.cpp", "bindings_training.cpp"))
    return len(re.findall(r"^ +POINTER\(", text, re.M)) + 2 * len(re.findall(r"^ +pointer_pair\(", text, re.M))


def test_a_field_that_the_kernels_do_not_have_is_refused(gpu):
    from cuda_ext.arrays import fill

    kernels = cuda_ext.load()
    with pytest.raises(TypeError, match="View has no field veiwmat; it has K, height, viewmat, width"):
        fill(kernels.View(), veiwmat=torch.zeros(16, device=gpu))
    with pytest.raises(TypeError, match=r"View\.width is a number, not a tensor"):
        fill(kernels.View(), width=torch.zeros(1, device=gpu))
