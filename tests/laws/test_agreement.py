"""The laws of `pop_ref.conformance.laws.test_agreement`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_agreement import *  # noqa: F403
