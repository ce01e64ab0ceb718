"""The laws of `pop_ref.conformance.laws.test_contributions`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_contributions import *  # noqa: F403
