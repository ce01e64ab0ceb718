"""The laws of `pop_ref.conformance.laws.test_camera`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_camera import *  # noqa: F403
