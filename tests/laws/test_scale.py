"""The laws of `pop_ref.conformance.laws.test_scale`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_scale import *  # noqa: F403
