"""The laws of `pop_ref.conformance.laws.test_footprint`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_footprint import *  # noqa: F403
