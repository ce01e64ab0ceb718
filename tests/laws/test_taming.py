"""The laws of `pop_ref.conformance.laws.test_taming`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_taming import *  # noqa: F403
