"""The laws of `pop_ref.conformance.laws.test_mini_splatting`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_mini_splatting import *  # noqa: F403
