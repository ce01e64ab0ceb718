"""The conformance kit's entry point, which pytest loads in every session; the kit itself only where one asks for it.

Options that the kit adds have plain names ("--profile", "--device"), which other plugins may use in sessions of their
own; so none is added before `pop_ref.conformance` stands among the words. The distribution installs this file as the
top-level module `pop_ref_pytest`: importing the package imports numpy and every stage, and a session that judges
nothing shall pay nothing.
"""

from __future__ import annotations

from importlib.util import find_spec

import pytest

KIT = "pop_ref.conformance"


@pytest.hookimpl(tryfirst=True)
def pytest_load_initial_conftests(early_config: pytest.Config, args: list[str]) -> None:
    """Load the plugin when the laws are named: as a package, or as a folder or file of it."""
    words = (word.replace("/", ".").replace("\\", ".") for word in args)
    if any(KIT in word for word in words):
        if find_spec("hypothesis") is None:
            raise pytest.UsageError("the laws need hypothesis: pip install 'pop-ref[conformance]'")
        early_config.pluginmanager.import_plugin(f"{KIT}.plugin")
