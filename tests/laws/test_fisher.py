"""The laws of `pop_ref.conformance.laws.test_fisher`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_fisher import *  # noqa: F403
