"""The laws of `pop_ref.conformance.laws.test_compositing`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_compositing import *  # noqa: F403
