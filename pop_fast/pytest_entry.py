"""The conformance kit's entry point, which pytest loads in every session; the kit itself only where one asks for it.

Options that the kit adds have plain names ("--profile", "--device"), which other plugins may use in sessions of their
own; so none is added before `pop_ref.conformance` stands among the words. The distribution pop-ref installs the same as
the module `pop_ref_pytest`; this one serves environments that were made when pop_ref belonged to pop-splatting.
"""

from __future__ import annotations

import pytest

KIT = "pop_ref.conformance"


@pytest.hookimpl(tryfirst=True)
def pytest_load_initial_conftests(early_config: pytest.Config, args: list[str]) -> None:
    """Load the plugin when the laws are named: as a package, or as a folder or file of it."""
    words = (word.replace("/", ".").replace("\\", ".") for word in args)
    if any(KIT in word for word in words):
        early_config.pluginmanager.import_plugin(f"{KIT}.plugin")
