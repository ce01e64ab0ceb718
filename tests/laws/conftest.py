"""The laws over our own backends: the oracle itself, and pop_fast in both precisions."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

pytest.register_assert_rewrite("pop_ref.conformance.laws")


# what follows is imported in the functions, after asserts have been registered to be rewritten
def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    from tests.judged import judge_own_backends

    judge_own_backends(metafunc)


@pytest.fixture(autouse=True, scope="module")
def _allocations_are_poisoned() -> Iterator[None]:
    from tests.judged import poisoned_allocations

    with poisoned_allocations("pop_fast"):
        yield
