"""The laws of `pop_ref.conformance.laws.test_activations`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_activations import *  # noqa: F403
