"""The jobs of the GPU check on what a bare node has: no git, no network, no package but the usual ones, $OUT set.

The kernels are emulated and the cases tiny (`--rehearse`); everything else is what runs on a node with a GPU. Such a
node has a Python with torch, the CUDA toolkit and the usual scientific packages, and none of the small packages that
`pip install pop-splatting` would bring along.
"""

from __future__ import annotations

import gzip
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import pytest

from cuda_ext.gpu_check.stages import JOBS
from cuda_ext.host import emulate
from pop_fast.cli import main as pop
from tests.cuda.conftest import FOLDER

ROOT = Path(__file__).resolve().parents[2]
WHEELS = ("plyfile", "tyro", "typeguard", "docstring_parser", "typing_extensions")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.rehearsal,
    pytest.mark.skipif(not (ROOT / ".git").exists(), reason="no git checkout to copy"),
    pytest.mark.skipif(emulate.why_not() is not None, reason=str(emulate.why_not())),
]


@pytest.fixture(scope="module")
def node(tmp_path_factory) -> tuple[Path, Path]:
    """Return the node's Python and its copy of the tree, with what travels in out/gpu_pack."""
    tmp = tmp_path_factory.mktemp("node")
    capture, run = tmp / "toy", tmp / "toy_pop"
    assert pop(["demo", str(capture), "--views", "8", "--width", "28", "--height", "24"]) == 0
    words = ["train", str(capture), "--out", str(run), "--max-steps", "3", "--backend", "fast", "--quiet"]
    assert pop(words) == 0
    tree = copy_of_the_tree(ROOT, tmp / "tree")
    assert not (tree / ".git").exists()
    # what is compiled of the same sources with the same flags is taken as it is; were the copy another, it would not be
    compiled = emulate.build(FOLDER).parent
    shutil.copytree(compiled, tree / "tests" / "cuda" / "emulated" / "build" / compiled.name)
    python = make_bare_node(tmp / "python")
    packed = tree / "out" / "gpu_pack"
    options = ["--no-wheels", "--runs", str(run), "--captures", str(capture), "--pixels", "1000"]
    done = gpu_check(Path(sys.executable), ROOT, "--pack", str(packed), *options)
    assert done.returncode == 0, done.stderr
    (packed / "wheels").mkdir()
    for name in WHEELS:
        installed_wheel(name, packed / "wheels")
    stand_in_gsplat(packed / "wheels")
    return python, tree


def gpu_check(python: Path, tree: Path, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [str(python), "-m", "cuda_ext.gpu_check", *words]
    over = bare_environment(**environment)
    return subprocess.run(command, cwd=tree, env=over, capture_output=True, text=True, check=False)


def job(node: tuple[Path, Path], number: int, out: Path, *words: str, **environment: str) -> dict[str, Any]:
    # no stage is cut off because the machine is busy
    plenty = ("--limit-s", "5000")
    done = gpu_check(*node, "--rehearse", "--job", str(number), *plenty, *words, OUT=str(out), **environment)
    report = json.loads((out / f"gpu_check_{number}.json").read_text())
    assert done.returncode == 0, (done.stdout, done.stderr, (out / f"gpu_check_{number}.log").read_text()[-4000:])
    assert report["complete"]
    assert list(report["stages"]) == list(JOBS[number])
    for name, stage in report["stages"].items():
        assert stage["status"] == 0, (name, stage)
        assert "skipped" not in stage, (name, stage)
    # what a node gives back: few files, none of them in a folder
    assert len(files := list(out.iterdir())) <= 8
    assert all(file.is_file() and file.stat().st_size < 2**24 for file in files)
    return report


def test_the_node_has_nothing_else(node):
    python = node[0]
    probe = f"import importlib.util as u; print([n for n in {ABSENT!r} if u.find_spec(n)])"
    done = subprocess.run([python, "-c", probe], cwd="/", env=bare_environment(), capture_output=True, text=True)
    assert done.stdout == "[]\n", done


def test_job_one_builds_and_gives_numbers(node, tmp_path):
    tools = stand_in_ncu(tmp_path / "bin" / "ncu")
    found = job(node, 1, tmp_path / "out", POP_COMMIT="c0ffee", **tools)
    assert found["environment"]["commit"] == "c0ffee"
    stages = found["stages"]
    assert stages["smoke"]["tests"]["failed"] == 0
    assert stages["smoke"]["tests"]["passed"] >= 7
    bench, beside = stages["bench"]["results"]["cases"], stages["gsplat"]["results"]["cases"]
    assert list(bench) == list(beside) == ["tiny", "toy_pop", "toy_pop_enlarged"]
    for case in bench.values():
        assert "failed" not in case
        assert case["pixel_parallel"]["step_ms"] > 0.0
        assert case["pixel_parallel_by_kernel"]["loads"]["contributing"] > 0
        # there are no kernels of a GPU to be profiled here, which is told and loses no time
        assert "profiler" in case["pixel_parallel"]["step_kernels"]["skipped"]
    assert bench["toy_pop_enlarged"]["width"] > bench["toy_pop"]["width"] == 28
    assert all(set(case["ratios"]) == {"forward", "forward_backward", "step"} for case in beside.values())
    assert stages["gsplat"]["results"]["gsplat"] == "stand-in"
    counters = stages["counters"]["results"]
    assert (counters["gpu"], counters["case"]) == ("emulated", "tiny")
    assert [kernel["kernel"] for kernel in counters["kernels"]] == ["pop::begin_step_kernel"]
    with gzip.open(tmp_path / "out" / "lines.csv.gz", "rt") as file:
        assert file.read().startswith('"Source"')


def test_job_two_judges_and_trains(node, tmp_path):
    # it wants the options and the environment that let it see, and runs the command
    wanted = '"--tool --report-api-errors --error-exitcode 1"'
    script = (f'[ "$1 $3 $5 $PYTORCH_NO_CUDA_MEMORY_CACHING" = {wanted} ] || exit 9', "shift 6", 'exec "$@"')
    path = stand_in_tool(tmp_path / "bin" / "compute-sanitizer", "#!/bin/sh", *script)
    found = job(node, 2, tmp_path / "out", "--steps-scaler", "0.001", **path)
    manifest = json.loads((node[1] / "out" / "gpu_pack" / "manifest.json").read_text())
    assert found["environment"]["commit"] == manifest["commit"] != "unknown"
    stages = found["stages"]
    for name in ("laws", "laws_of_gaussian_parallel", "steps"):
        assert stages[name]["tests"]["failed"] == 0
        assert stages[name]["tests"]["passed"] >= 1
        assert "shapes were NOT checked: beartype" in stages[name]["output"]
    assert stages["sanitizer"]["memcheck"]["tests"]["passed"] == 4
    trained = stages["train"]["runs"]["toy"]
    assert trained["step"] == 29
    assert trained["psnr"] > 5.0
    assert trained["gpu"] == "emulated"


def test_job_four_trains_by_several(node, tmp_path):
    stages = job(node, 4, tmp_path)["stages"]
    ranks = stages["ranks"]
    assert (ranks["gpus"], ranks["same_bits"]) == (2, True)
    alone, two = ranks["runs"]["1"], ranks["runs"]["2"]
    assert alone["step"] == two["step"] == 7
    assert alone["received_bytes"] == 0 < two["received_bytes"]
    assert len(alone["sha256"]) == 64
    assert stages["blocks"]["runs"]["blocks"]["psnr"] > 5.0
    assert stages["blocks"]["runs"]["whole"]["gpu"] == "emulated"


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
