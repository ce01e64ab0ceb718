"""The laws of `pop_ref.conformance.laws.test_selection`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_selection import *  # noqa: F403
