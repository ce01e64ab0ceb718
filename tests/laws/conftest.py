"""The laws over our own backends: the oracle itself, and pop_fast in both precisions."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

pytest.register_assert_rewrite("pop_ref.conformance.laws")

from pop_ref.conformance.poison import poisoned_allocations  # noqa: E402  asserts must be rewritten first
from tests.judged import judge_own_backends  # noqa: E402


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    judge_own_backends(metafunc)


@pytest.fixture(autouse=True, scope="module")
def _allocations_are_poisoned() -> Iterator[None]:
    with poisoned_allocations("pop_fast"):
        yield
