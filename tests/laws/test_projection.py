"""The laws of `pop_ref.conformance.laws.test_projection`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_projection import *  # noqa: F403
