"""The laws over the host mirror: the CUDA kernels' mathematics, without a GPU."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import pytest

from cuda_ext.compiler import find_compiler

pytest.register_assert_rewrite("pop_ref.conformance.laws")

from pop_ref.conformance.backends import shipped  # noqa: E402  asserts must be rewritten first
from pop_ref.conformance.plugin import parametrize_backends  # noqa: E402


@functools.cache
def mirrors() -> list[Any]:
    return [shipped("mirror64"), shipped("mirror32")]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    # the folder of tests that need a GPU has backends of its own
    if "backend" not in metafunc.fixturenames or metafunc.definition.path.parent != Path(__file__).parent:
        return
    if find_compiler() is None:
        mark = pytest.mark.skip(reason="no C++ compiler: the host mirror cannot be built (install g++ or set CXX)")
        metafunc.parametrize("backend", [pytest.param(None, id="mirror", marks=[mark])])
        return
    # in double the mirror is the oracle to 1e-12, for which the laws are proved already; float has to stand by itself
    agreement = metafunc.cls is not None and metafunc.cls.__name__ == "TestAgreement"
    parametrize_backends(metafunc, mirrors() if agreement else mirrors()[1:])
