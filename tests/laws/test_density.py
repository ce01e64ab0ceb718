"""The laws of `pop_ref.conformance.laws.test_density`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_density import *  # noqa: F403
