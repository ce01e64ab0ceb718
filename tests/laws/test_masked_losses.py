"""The laws of `pop_ref.conformance.laws.test_masked_losses`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_masked_losses import *  # noqa: F403
