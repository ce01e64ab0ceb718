"""The torch implementation for CPUs, and the program around it: captures in, compact splats out."""

from __future__ import annotations

from pop_fast.moved import keep_old_names

keep_old_names(__name__)
