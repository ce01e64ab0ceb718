"""The laws of `pop_ref.conformance.laws.test_signature_cameras`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_signature_cameras import *  # noqa: F403
