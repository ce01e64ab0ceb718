"""The laws of `pop_ref.conformance.laws.test_optimizer`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_optimizer import *  # noqa: F403
