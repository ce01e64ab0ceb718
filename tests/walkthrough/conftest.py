"""A folder in which the workers of a session share what the chapters did, and a browser."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.walkthrough import ran
from tests.walkthrough.chromium import Page, opened


@pytest.fixture(scope="session", autouse=True)
def _shared_runs(tmp_path_factory: pytest.TempPathFactory) -> None:
    base = tmp_path_factory.getbasetemp()
    # a worker of xdist has a folder of its own in that of the session
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "chapters-that-ran"
    folder.mkdir(exist_ok=True)
    ran.shared = folder


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    with opened() as page:
        yield page
