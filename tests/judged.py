"""Which backends the laws are run over here."""

from __future__ import annotations

from typing import Any

import pytest

from pop_ref.conformance.backends import SHIPPED, Absent, shipped, shipped_or_absent
from pop_ref.conformance.law import missing
from pop_ref.conformance.plugin import parametrize_backends


def judge_own_backends(metafunc: pytest.Metafunc) -> None:
    """Run a law over the oracle and `pop_fast`, in torch and, where a compiled stage is in it, in C++, too.

    What trains counts among those; every other stage is the same code there, so that its laws have nothing to judge.
    """
    stated = getattr(metafunc.function, "law", None)
    compiled: list[Any] = [shipped_or_absent(name) for name in ("compiled64", "compiled32")]
    concerned = [b for b in compiled if isinstance(b, Absent) or not (stated and missing(b, stated.needs))]
    parametrize_backends(metafunc, [*map(shipped, SHIPPED), *concerned])
