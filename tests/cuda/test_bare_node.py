"""The jobs of the GPU check on what a bare node has: no git, no network, no package but the usual ones, $OUT set.

The kernels are emulated and the cases tiny (`--rehearse`); everything else is what runs on a node with a GPU.
"""

from __future__ import annotations

import gzip
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from cuda_ext.gpu_check.stages import JOBS
from cuda_ext.host import emulate
from pop_fast.cli import main as pop
from tests.cuda.bare_node import (
    ABSENT,
    bare_environment,
    copy_of_the_tree,
    installed_wheel,
    make_bare_node,
    stand_in_gsplat,
    stand_in_ncu,
    stand_in_tool,
)
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
