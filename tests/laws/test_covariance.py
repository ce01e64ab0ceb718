"""The laws of `pop_ref.conformance.laws.test_covariance`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_covariance import *  # noqa: F403
