"""How many examples a law is tried on: the Hypothesis profiles dev, ci and thorough, registered in one place."""

from __future__ import annotations

from hypothesis import HealthCheck, settings

EXAMPLES = {"dev": 25, "ci": 50, "thorough": 500}


def load_profile(name: str) -> None:
    """Register the profiles and choose one; `ci` draws the same examples every time.

    Raises:
        ValueError: there is no such profile.
    """
    if name not in EXAMPLES:
        raise ValueError(f"HYPOTHESIS_PROFILE is {name!r}; use one of {', '.join(EXAMPLES)}")
    checks = [HealthCheck.too_slow, HealthCheck.data_too_large]
    for each, count in EXAMPLES.items():
        settings.register_profile(
            each,
            max_examples=count,
            deadline=None,
            suppress_health_check=checks,
            derandomize=each == "ci",
            # one law, one failure: the report is about a single scene
            report_multiple_bugs=False,
            print_blob=each == "ci",
        )
    settings.load_profile(name)
