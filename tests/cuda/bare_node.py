"""A Python environment that holds what a bare GPU node has, and nothing else that is installed here.

A node to which only this repository is carried has a Python with torch, the CUDA toolkit and the usual scientific
packages; it has no network, and none of the small packages that `pip install pop-splatting` would bring along.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
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


def copy_of_the_tree(root: Path, folder: Path) -> Path:
    """Copy what git knows of a checkout, and what it would not ignore, without `.git`."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=root, check=True, capture_output=True, text=True).stdout.split("\0")
    for name in filter(None, names):
        if (root / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(root / name, folder / name)
    return folder


def installed_wheel(name: str, folder: Path) -> Path:
    """Make a wheel of a package that is installed here, as `pip download` would have fetched it."""
    found = distribution(name)
    target = folder / f"{found.metadata['Name'].replace('-', '_')}-{found.version}-py3-none-any.whl"
    with zipfile.ZipFile(target, "w") as wheel:
        for path in found.files or ():
            if path.parts[0] != ".." and path.suffix != ".pyc" and path.name not in ("INSTALLER", "REQUESTED"):
                wheel.write(str(found.locate_file(path)), path.as_posix())
    return target


def stand_in_tool(path: Path, *lines: str) -> dict[str, str]:
    """Make a script in the place of one of NVIDIA's tools, and give the environment in which it is found."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    path.chmod(0o755)
    return {"PATH": f"{path.parent}:{bare_environment()['PATH']}"}


def stand_in_ncu(path: Path) -> dict[str, str]:
    """Put a script in the place of Nsight Compute, which runs the command and tells one kernel of every metric asked.

    The command begins where an option would, with the name of a Python; the report that a command with `-o` leaves is
    what one with `-i` reads.
    """
    return stand_in_tool(
        path,
        f"#!{sys.executable}",
        "import pathlib, subprocess, sys",
        "words = sys.argv[1:]",
        "of = dict(zip(words, words[1:]))",
        "if '-i' in of:",
        "    print(pathlib.Path(of['-i']).read_text()); sys.exit()",
        "at = next(k for k, word in enumerate(words) if k and pathlib.Path(word).name.startswith('python'))",
        "done = subprocess.run(words[at:])",
        "assert words[:4] == ['--clock-control', 'none', '--profile-from-start', 'off'], words",
        "if '-o' in of:",
        "    pathlib.Path(of['-o']).write_text('\"Source\",\"# Samples\"')",
        "else:",
        "    print('==PROF== Connected')",
        '    print(\'"ID","Kernel Name","Metric Name","Metric Value"\')',
        "    for metric in of['--metrics'].split(',regex:')[0].split(','):",
        '        print(f\'"0","pop::begin_step_kernel(int)","{metric}","1"\')',
        "sys.exit(done.returncode)",
    )


def stand_in_gsplat(folder: Path) -> Path:
    """Make a wheel whose `gsplat.rasterization` is the CPU's, and whose kernels are compiled at once."""
    target = folder / "gsplat-0.0-py3-none-any.whl"
    files = {
        "gsplat/__init__.py": 'from pop_fast.api.rasterize import rasterization\n\n__version__ = "stand-in"\n',
        "gsplat/cuda/__init__.py": "",
        "gsplat/cuda/_backend.py": "_C = object()\n",
        "gsplat-0.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: gsplat\nVersion: 0.0\n",
        "gsplat-0.0.dist-info/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    listed = "".join(f"{name},,\n" for name in (*files, "gsplat-0.0.dist-info/RECORD"))
    with zipfile.ZipFile(target, "w") as wheel:
        for name, text in {**files, "gsplat-0.0.dist-info/RECORD": listed}.items():
            wheel.writestr(name, text)
    return target
