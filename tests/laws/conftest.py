"""The laws over our own backends: the oracle itself, and pop_fast in both precisions."""

from __future__ import annotations

import functools
import importlib
from typing import Any

import pytest

pytest.register_assert_rewrite("pop_ref.conformance.laws")

from pop_ref.conformance import tolerances  # noqa: E402  asserts must be rewritten first
from pop_ref.conformance.adapter import OracleAdapter  # noqa: E402
from pop_ref.conformance.plugin import parametrize_backends  # noqa: E402
from pop_ref.conformance.torch_adapter import TorchAdapter  # noqa: E402


@functools.cache
def our_backends() -> list[Any]:
    try:
        rasterization = importlib.import_module("pop_fast.rasterization").rasterization
    except Exception:
        rasterization = None
    return [
        OracleAdapter(),
        TorchAdapter("fast64", rasterization, "pop_fast", "float64"),
        TorchAdapter("fast32", rasterization, "pop_fast", "float32"),
    ]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    parametrize_backends(metafunc, our_backends())


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--record-worst", action="store_true", help="print the units that each tolerance needed")


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    if config.getoption("--record-worst", default=False):
        terminalreporter.section("units needed")
        for (key, dtype), units in sorted(tolerances.measured().items()):
            terminalreporter.write_line(f"{key:40s} {dtype:8s} {units:10.3g}")
