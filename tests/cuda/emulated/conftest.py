"""The tests of what only the emulator shows."""

from __future__ import annotations

from typing import Any

import pytest


@pytest.fixture
def gpu(emulated_card: Any) -> Any:
    """Return the device of the emulated GPU."""
    return emulated_card
