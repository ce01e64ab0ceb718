"""Import modules when one of their names is first used, or in the background while something else is waited for."""

from __future__ import annotations

import contextlib
import importlib
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final


def given_by(package: str, modules: Mapping[str, tuple[str, ...]]) -> Callable[[str], Any]:
    """Make the `__getattr__` of a package (PEP 562), by which names each of its modules gives."""
    homes = {name: f"{package}.{module}" for module, names in modules.items() for name in names}

    def find(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(homes[name]), name)

    return find


# s; a thread that decodes photographs asks for the interpreter for microseconds at a time, and would wait 5 ms for it:
# reading 50 photographs next to a thread that computes in Python took 4.0 to 4.9 s so, and 3.1 s with this
_SWITCH_INTERVAL: Final = 2e-4


@contextlib.contextmanager
def background_import(*modules: str) -> Iterator[None]:
    """Import modules in a thread of their own while the block runs; they are there, or have failed, when it ends.

    A block that is left by an error or an interruption waits for nothing. A failure is not reported here: whoever
    imports such a module afterwards meets it. The block must have imported all that it needs, as two threads do not
    import one package at a time.
    """

    def work() -> None:
        with contextlib.suppress(Exception):
            for name in modules:
                importlib.import_module(name)

    thread = threading.Thread(target=work, name="importing", daemon=True)
    before = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_INTERVAL)
    thread.start()
    try:
        yield
        thread.join()
    finally:
        sys.setswitchinterval(before)
