"""The laws of `pop_ref.conformance.laws.test_culled`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_culled import *  # noqa: F403
