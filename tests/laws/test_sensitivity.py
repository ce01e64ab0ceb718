"""The laws of `pop_ref.conformance.laws.test_sensitivity`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_sensitivity import *  # noqa: F403
