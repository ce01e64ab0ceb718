"""A Python environment that holds what a bare GPU node has, and nothing else that is installed here.

A node to which only this repository is carried has a Python with torch, the CUDA toolkit and the usual scientific
packages; it has no network, and none of the small packages that `pip install pop-splatting` would bring along.
"""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

# distributions, by the names that pip knows them by
THERE = (
    *("attrs", "cmake", "contourpy", "cuda-bindings", "cycler", "filelock", "fonttools", "fsspec", "hypothesis"),
    *("iniconfig", "jaxtyping", "jinja2", "kiwisolver", "markupsafe", "matplotlib", "mpmath", "nanobind", "networkx"),
    *("ninja", "numpy", "opencv-contrib-python-headless", "opencv-python-headless", "packaging", "pillow", "pip"),
    *("pluggy", "psutil", "pygments", "pyparsing", "pytest", "python-dateutil", "pyyaml", "rich", "scipy"),
    *("setuptools", "six", "sortedcontainers", "sympy", "torch", "tqdm", "typing-extensions", "wadler-lindig", "wheel"),
)
ABSENT = ("beartype", "gsplat", "plyfile", "pop_fast", "pycolmap", "tyro", "typeguard", "docstring_parser")


def make_bare_node(folder: Path) -> Path:
    """Make the environment: links to the packages of this one that such a node has too.

    Returns:
        Its Python.
    """
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    python = folder / "bin" / "python"
    site = Path(sysconfig.get_path("purelib", vars={"base": str(folder), "platbase": str(folder)}))
    for name in THERE:
        try:
            found = distribution(name)
        except PackageNotFoundError:
            continue
        tops = {path.parts[0] for path in found.files or () if path.parts[0] not in ("..", "__pycache__")}
        for top in tops:
            source = Path(str(found.locate_file(top)))
            if source.exists() and not (site / top).exists():
                (site / top).symlink_to(source)
    return python


def bare_environment(**changes: str) -> dict[str, str]:
    """Return this process's environment without what would lead Python back to this checkout or its packages."""
    dropped = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "OUT")
    return {**{name: value for name, value in os.environ.items() if name not in dropped}, **changes}
