"""Compile the CPU kernels into the wheel where POP_WHEEL_KERNELS=1 asks for it; else the wheel is of Python alone."""

from __future__ import annotations

import os
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).resolve().parent


class KernelsHook(BuildHookInterface):
    """Add one library for each level of instructions that `pop_fast.compiled.build` knows of this kind of machine."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile them and tell hatchling of them; an editable install compiles for its own machine instead."""
        if os.environ.get("POP_WHEEL_KERNELS") != "1" or version == "editable":
            return
        sys.path.insert(0, str(ROOT))
        from pop_fast.compiled.build import build_levels

        self.folder = tempfile.TemporaryDirectory()
        for library in build_levels(Path(self.folder.name)):
            build_data["force_include"][str(library)] = f"pop_fast/compiled/{library.name}"
        build_data["pure_python"] = False
        # ctypes loads the libraries, so that one wheel serves every Python of this platform
        build_data["tag"] = "py3-none-" + sysconfig.get_platform().replace("-", "_").replace(".", "_")

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what was compiled."""
        if hasattr(self, "folder"):
            self.folder.cleanup()
