"""The laws of `pop_ref.conformance.laws.test_whole`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_whole import *  # noqa: F403
