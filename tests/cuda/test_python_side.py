"""The Python side of the CUDA extension on a machine that cannot run it: reasons, refusals, errors, parsing."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import cuda_ext
from cuda_ext import build as build_module
from cuda_ext.build import BuildError
from cuda_ext.machine_code.check_ptxas import KernelUse, as_table, offenders, parse_ptxas
from cuda_ext.toolkit import find_nvcc

PTXAS = """
ptxas info    : Compiling entry function '_ZN3pop20blend_forward_kernelE' for 'sm_90'
ptxas info    : Function properties for _ZN3pop20blend_forward_kernelE
    8 bytes stack frame, 4 bytes spill stores, 16 bytes spill loads
ptxas info    : Used 55 registers, used 1 barriers, 6144 bytes smem
"""


def test_importing_the_package_loads_neither_torch_nor_the_kernels():
    script = "import sys, cuda_ext; assert not {'torch', 'cuda_ext._kernels'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", script], check=True)


def test_an_extension_that_is_not_built_says_how_to_build_it(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    reason = cuda_ext.why_not()
    assert reason is not None
    assert "not built" in reason
    assert "pop build-cuda" in reason
    assert not cuda_ext.available()


def test_a_cpu_build_of_torch_is_named(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(cuda_ext, "load", lambda: type("Kernels", (), {"ARCHS": "90"}))
    monkeypatch.setattr(torch.version, "cuda", None)
    assert "is a CPU build" in str(cuda_ext.why_not())


@pytest.mark.parametrize(
    ("driver", "words"),
    [
        (0, "there is no NVIDIA driver"),
        (12040, "the driver knows CUDA 12.4, the CUDA extension was built with 13.0; update the driver"),
        (13010, "torch finds no usable GPU (the driver on your system is too old); check `nvidia-smi`"),
    ],
)
def test_a_missing_or_wrong_driver_is_named(monkeypatch, driver, words):
    def init():
        raise RuntimeError("the driver on your system is too old. Please update it.")

    kernels = {"ARCHS": "90", "RUNTIME": 13000, "driver_version": staticmethod(lambda: driver)}
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(cuda_ext, "load", lambda: type("Kernels", (), kernels))
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.cuda, "init", init)
    assert words in str(cuda_ext.why_not())


def test_a_machine_that_can_run_it_is_asked_once(monkeypatch):
    kernels = {"ARCHS": "90", "RUNTIME": 12040, "driver_version": staticmethod(lambda: 13000)}
    asked = []
    monkeypatch.setattr(cuda_ext, "_could_run", [])
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: asked.append(name) or object())
    monkeypatch.setattr(cuda_ext, "load", lambda: type("Kernels", (), kernels))
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (9, 0))
    assert cuda_ext.available()
    assert cuda_ext.available()
    assert len(asked) == 1


@pytest.mark.parametrize(
    ("capability", "archs", "runs"),
    [
        ((9, 0), "90", True),
        ((8, 9), "80-real,90", True),
        ((10, 0), "75-real,90", True),
        ((10, 0), "90-real", False),
        ((7, 5), "80-real,90", False),
        ((7, 0), "75", False),
    ],
)
def test_a_gpu_runs_code_of_its_generation_or_newer_ptx(capability, archs, runs):
    reason = cuda_ext._why_not_this_gpu(capability, archs)
    assert (reason is None) == runs
    if reason:
        assert f"--arch sm_{capability[0]}{capability[1]}" in reason


def test_a_module_that_does_not_load_asks_to_be_built_again(monkeypatch):
    def fails():
        raise ImportError("undefined symbol")

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(cuda_ext, "load", fails)
    assert "build it again" in str(cuda_ext.why_not())


@pytest.mark.parametrize(
    ("missing", "words"), [("nvcc", "CUDACXX"), ("cmake", "[cuda-build]"), ("nanobind", "[cuda-build]")]
)
def test_a_missing_build_tool_is_named_with_its_cure(monkeypatch, missing, words):
    monkeypatch.setattr(build_module, "find_nvcc", lambda: None if missing == "nvcc" else "/bin/nvcc")
    monkeypatch.setattr(build_module.shutil, "which", lambda name, path: None if name == missing else f"/bin/{name}")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == missing else object())
    with pytest.raises(BuildError, match=missing) as error:
        build_module.build("sm_90")
    assert words in str(error.value)


@pytest.mark.parametrize(("arch", "words"), [("sm_70", "too old"), ("hopper", "like sm_90"), ("sm_120", "newer CUDA")])
def test_an_architecture_that_cannot_be_built_for_is_refused(monkeypatch, arch, words):
    monkeypatch.setattr(build_module, "nvcc_version", lambda nvcc: (12, 4))
    with pytest.raises(BuildError, match=words):
        build_module._architectures(arch, "nvcc")


def test_machine_code_is_made_for_each_architecture_and_ptx_for_the_newest(monkeypatch):
    monkeypatch.setattr(build_module, "nvcc_version", lambda nvcc: (13, 0))
    assert build_module._architectures(["sm_90", "sm_75", "80"], "nvcc") == ["75-real", "80-real", "90"]


def test_a_failing_compiler_is_quoted():
    with pytest.raises(BuildError, match="compiling the CUDA extension failed") as error:
        build_module._run("compiling", [sys.executable, "-c", "import sys; print('its words'); sys.exit(3)"])
    assert "its words" in str(error.value)


def test_rasterization_refuses_what_it_does_not_support_and_names_what_is_wrong(monkeypatch):
    from pop_fast.cuda import rasterization

    rows = {
        "means": torch.zeros(1, 3),
        "quats": torch.ones(1, 4),
        "scales": torch.ones(1, 3),
        "opacities": torch.ones(1),
        "colors": torch.ones(1, 3),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.eye(3)[None],
        "width": 4,
        "height": 4,
    }
    from pop_fast.cuda import backend

    monkeypatch.setattr(backend.cuda_ext, "why_not", lambda: None)
    with pytest.raises(NotImplementedError, match=r"covars=.* by backend 'cuda': the kernels start from quats"):
        rasterization(**rows, covars=torch.zeros(1, 3, 3))
    with pytest.raises(ValueError, match="render_mode"):
        rasterization(**rows, render_mode="normals")
    with pytest.raises(ValueError, match="width is 0"):
        rasterization(**{**rows, "width": 0})
    with pytest.raises(ValueError, match=r"means is on cpu; backend 'cuda' reads cuda: use means\.cuda\(\)"):
        rasterization(**rows)


def test_the_signature_is_the_cpus():
    import inspect

    from pop_fast.api import rasterization as on_every_backend
    from pop_fast.cuda import rasterization as on_gpu

    assert inspect.signature(on_gpu) == inspect.signature(on_every_backend)


def test_the_laws_of_antialiased_mode_judge_every_kind_of_the_cuda_backend():
    from pop_ref.conformance.capabilities import ANTIALIASING, PROFILES
    from tests.cuda.gpu.conftest import cuda_backends

    backends = cuda_backends("cpu", "cuda")
    assert {backend.name for backend in backends} == {
        "cuda32-pixel_parallel",
        "cuda32-gaussian_parallel",
        "cuda32-atomics",
    }
    assert all(backend.has(need) for backend in backends for need in (ANTIALIASING, PROFILES))


def test_spills_and_registers_are_read_from_the_compilers_words():
    (use,) = parse_ptxas("blend_forward.cu", PTXAS)
    assert (use.registers, use.shared, use.stack, use.spill_stores, use.spill_loads) == (55, 6144, 8, 4, 16)
    assert use.spills


def test_a_spilling_blend_kernel_offends_and_another_does_not():
    blend = KernelUse("a.cu", "columns_kernel<3, false, false>", "sm_75", 255, 0, 8, 8, 8)
    other = KernelUse("a.cu", "project_backward_kernel", "sm_75", 255, 0, 8, 8, 8)
    assert offenders([blend, other]) == [blend]
    assert "8+8 B!" in as_table([blend])


def test_every_kernel_file_is_built():
    folder = Path(cuda_ext.__file__).parent
    listed = (folder / "CMakeLists.txt").read_text()
    assert [path.name for path in (folder / "csrc").glob("*.cu") if f"csrc/{path.name}" not in listed] == []


@pytest.mark.slow
@pytest.mark.skipif(find_nvcc() is None, reason="no nvcc: the kernels are not compiled here (install a CUDA toolkit)")
def test_the_blend_kernels_compile_for_turing_without_spills():
    from cuda_ext.machine_code.check_ptxas import check

    assert offenders(check(["sm_75"], only="blend")) == []
