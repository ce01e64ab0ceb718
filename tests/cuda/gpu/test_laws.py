"""The laws of the kit over the CUDA backend: a class for each module of laws."""

from __future__ import annotations

from tests.judged import law_classes

globals().update(law_classes(("whole", "compositing", "dominance", "gradients", "agreement")))
