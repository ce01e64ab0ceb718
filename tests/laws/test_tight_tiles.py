"""The laws of `pop_ref.conformance.laws.test_tight_tiles`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_tight_tiles import *  # noqa: F403
