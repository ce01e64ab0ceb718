"""The kit that judges a rasterizer by the oracle: strategies, laws, tolerances, thresholds and mutants.

    pytest --pyargs pop_ref.conformance --rasterizer my.module:rasterization --profile gsplat_1_6

A law is a sentence that every correct rasterizer obeys; it is written once, in `laws`, against an `Adapter`, and runs
over every backend and over the oracle itself. Needs numpy, hypothesis and pytest; an adapter imports what it adapts.

In reading order: `scenes` (what is drawn), `strategies` (how it is drawn), `adapter` (what is judged), `tolerances` and
`error_bounds` (how much rounding costs), `thresholds` (what rounding may decide), `assertions`.
"""

from pop_ref.conformance.adapter import Adapter, View
from pop_ref.conformance.scenes import Scene

__all__ = ["Adapter", "Scene", "View"]
