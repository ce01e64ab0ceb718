"""Every law of the kit over every backend of our own that the law speaks to: a class for each module of laws."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

pytest.register_assert_rewrite("pop_ref.conformance.laws")

from tests.judged import (  # noqa: E402
    LAW_MODULES,
    judge_own_backends,
    law_classes,
    poisoned_allocations,
)

globals().update(law_classes(LAW_MODULES))
pytest_generate_tests = judge_own_backends


@pytest.fixture(autouse=True, scope="module")
def _allocations_are_poisoned() -> Iterator[None]:
    with poisoned_allocations("pop_fast"):
        yield
