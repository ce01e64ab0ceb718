"""The laws of `pop_ref.conformance.laws.test_gradients`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_gradients import *  # noqa: F403
