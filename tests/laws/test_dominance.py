"""The laws of `pop_ref.conformance.laws.test_dominance`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_dominance import *  # noqa: F403
