"""Lay out the wheel of pop-ref: this folder as the package pop_ref, and the pytest plugin's entry next to it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

# of the distribution, not of the package
_LEFT_OUT = {"LICENSE", "PKG-INFO", "pyproject.toml", "README.md"}
_NOT_ITS_FOLDERS = {"__pycache__", "build", "dist", "packaging"}


class PackageHook(BuildHookInterface):
    """Give every file its place; an editable install finds the package in the folder above and needs the entry only."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Tell hatchling of the files."""
        root = Path(self.root)
        entry = {str(root / "conformance" / "pytest_entry.py"): "pop_ref_pytest.py"}
        if version == "editable":
            build_data["force_include_editable"] = entry
            return
        paths = [path.relative_to(root) for path in sorted(root.rglob("*")) if path.is_file()]
        for path in paths:
            if path.name.startswith(".") or str(path) in _LEFT_OUT or _NOT_ITS_FOLDERS & set(path.parts):
                continue
            build_data["force_include"][str(root / path)] = f"pop_ref/{path.as_posix()}"
        build_data["force_include"].update(entry)
