"""A pytest plugin: one line of JSON for every test that has ended, at once, so that a cut run tells how far it got.

POP_OUTCOMES=laws.jsonl python -m pytest -p cuda_ext.gpu_check.outcomes ...
"""

from __future__ import annotations

import json
import os
from collections import Counter
from pathlib import Path
from typing import Any

FILE = "POP_OUTCOMES"
SHOWN = 20  # failures that are listed one by one
_WORDS = 400  # characters of a failure's last lines


def pytest_configure(config: Any) -> None:
    """Write where the environment says so; pytest-xdist's workers tell the process that started them."""
    path = os.environ.get(FILE)
    if path and not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Outcomes(Path(path)))


class _Outcomes:
    def __init__(self, path: Path) -> None:
        self._path = path

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Write down how a test ended; a test that passes has done so when its call has."""
        if report.when == "call" or report.outcome != "passed":
            self._write(report.nodeid, report.outcome, report.duration, report.longreprtext)

    def pytest_collectreport(self, report: Any) -> None:
        """Write down a file whose tests cannot be collected."""
        if report.outcome == "failed":
            self._write(report.nodeid, "failed", 0.0, report.longreprtext)

    def _write(self, test: str, outcome: str, seconds: float, words: str) -> None:
        line = {"test": test, "outcome": outcome, "seconds": round(seconds, 2), "words": words[-_WORDS:]}
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")


def outcomes(path: Path) -> dict[str, Any]:
    """Add up a file of outcomes: counts, the failures, the slowest tests, why tests were skipped.

    A line that a kill has cut off, or that something else has damaged, is counted as `damaged` and left out.
    """
    if not path.exists():
        return {"passed": 0, "failed": 0, "skipped": 0}
    lines = path.read_bytes().splitlines()
    tests = [test for line in lines if (test := _outcome(line)) is not None]
    counts = Counter(test["outcome"] for test in tests)
    slowest = sorted(tests, key=lambda test: -test["seconds"])[:5]
    reasons = Counter(test["words"] for test in tests if test["outcome"] == "skipped")
    return {
        **{name: counts[name] for name in ("passed", "failed", "skipped")},
        **({"damaged": len(lines) - len(tests)} if len(tests) < len(lines) else {}),
        "failures": [test for test in tests if test["outcome"] == "failed"][:SHOWN],
        "slowest": {test["test"]: test["seconds"] for test in slowest},
        "skipped_for": dict(reasons.most_common(5)),
    }


def _outcome(line: bytes) -> dict[str, Any] | None:
    try:
        test = json.loads(line)
    except (ValueError, RecursionError):
        return None
    texts = isinstance(test, dict) and all(isinstance(test.get(key), str) for key in ("test", "outcome", "words"))
    return test if texts and isinstance(test.get("seconds"), int | float) else None
