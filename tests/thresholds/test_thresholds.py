"""The laws of `pop_ref.conformance.laws.test_thresholds`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_thresholds import *  # noqa: F403
