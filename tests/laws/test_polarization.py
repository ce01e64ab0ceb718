"""The laws of `pop_ref.conformance.laws.test_polarization`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_polarization import *  # noqa: F403
