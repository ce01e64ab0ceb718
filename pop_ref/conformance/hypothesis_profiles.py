"""How many examples a law is tried on, and which: the Hypothesis profiles, registered in one place.

`quick`, `dev`, `ci` and `thorough` draw the same examples on every machine and every time: each test's draws follow
from its own source. `explore` draws anew, from the seed given by pytest's `--hypothesis-seed`.

Hypothesis also draws constants that it finds in the modules of the working folder which happen to be imported. With
them the examples would depend on which tests were collected, on where the kit is installed, and on every number that is
changed anywhere; they are left out.
"""

from __future__ import annotations

from typing import Final

from hypothesis import HealthCheck, settings

EXAMPLES: Final = {"quick": 5, "dev": 15, "ci": 24, "thorough": 500, "explore": 25}


def load_profile(name: str) -> None:
    """Register the profiles and choose one; from then on no draw depends on what is imported.

    Raises:
        ValueError: there is no such profile.
    """
    if name not in EXAMPLES:
        raise ValueError(f"HYPOTHESIS_PROFILE is {name!r}; use one of {', '.join(EXAMPLES)}")
    _leave_out_mined_constants()
    # an implementation of one profile sets the examples of the others aside
    checks = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much]
    for each, count in EXAMPLES.items():
        settings.register_profile(
            each,
            max_examples=count,
            deadline=None,
            suppress_health_check=checks,
            derandomize=each != "explore",
            # an example kept from an earlier run would be tried here and nowhere else
            database=None,
            # one law, one failure: the report is about a single scene
            report_multiple_bugs=False,
            print_blob=True,
        )
    settings.load_profile(name)


def _leave_out_mined_constants() -> None:
    """Have Hypothesis find no constants in local modules; there is no setting for it."""
    try:
        from hypothesis.internal.conjecture import providers
        from hypothesis.internal.constants_ast import Constants
    except ImportError:
        # before 6.131 it looked for none; should a later release keep them elsewhere, a test of this project fails
        return
    providers._get_local_constants = Constants
    providers.CONSTANTS_CACHE.cache.clear()
