"""The laws of `pop_ref.conformance.laws.test_signature_arguments`, over our own backends."""

from __future__ import annotations

from pop_ref.conformance.laws.test_signature_arguments import *  # noqa: F403
