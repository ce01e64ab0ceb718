"""The laws of `pop_ref.conformance.laws.test_alpha`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_alpha import *  # noqa: F403
