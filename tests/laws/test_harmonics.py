"""The laws of `pop_ref.conformance.laws.test_harmonics`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_harmonics import *  # noqa: F403
