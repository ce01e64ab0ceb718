"""The laws of `pop_ref.conformance.laws.test_chord`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_chord import *  # noqa: F403
