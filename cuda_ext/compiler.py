"""Find the C++ compiler of this machine."""

from __future__ import annotations

import os
import shlex
import shutil


def find_compiler() -> list[str] | None:
    """Return the command of a C++17 compiler: what CXX says where it is set, else g++, clang++ or c++; None without."""
    given = shlex.split(os.environ.get("CXX", ""))
    for command in [given] if given else [["g++"], ["clang++"], ["c++"]]:
        found = shutil.which(command[0])
        if found:
            return [found, *command[1:]]
    return None


def no_compiler() -> str:
    """Return one sentence on why `find_compiler` found none and what to do."""
    given = os.environ.get("CXX", "").strip()
    if given:
        return f"CXX is {given!r}, which is not on this machine; set it to a C++ compiler's path, or unset it"
    return "no C++ compiler was found; install g++ or clang++, or set CXX to one's path"
