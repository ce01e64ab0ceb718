"""The Python side of the CUDA extension on a machine that cannot run it: reasons, refusals, errors, parsing."""

from __future__ import annotations

import gc
import importlib.util
import inspect
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import cuda_ext
from cuda_ext import build as build_module
from cuda_ext.build import BuildError
from cuda_ext.machine_code.check_ptxas import KernelUse, as_table, check, offenders, parse_ptxas
from cuda_ext.render.lists import GROWTH, MOST, Capacity
from cuda_ext.toolkit import find_nvcc
from cuda_ext.training.train_step import Watch, captured
from pop_fast.api import backends
from pop_fast.api import rasterization as on_every_backend
from pop_fast.cuda import rasterization
from pop_ref.conformance.capabilities import ANTIALIASING, PROFILES
from tests.cuda.gpu.conftest import FOLDER, cuda_backends
from tests.cuda.gpu.conftest import pytest_collection_modifyitems as put_graphs_first

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


@pytest.fixture
def built(monkeypatch):
    """Let the extension be built, for a runtime and a driver, next to a torch for so new a CUDA."""

    def seem(torchs: str | None = "13.0", runtime: int = 13000, driver: int = 13000) -> list[str]:
        asked: list[str] = []
        kernels = {"ARCHS": "90", "RUNTIME": runtime, "driver_version": staticmethod(lambda: driver)}
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: asked.append(name) or object())
        monkeypatch.setattr(cuda_ext, "load", lambda: type("Kernels", (), kernels))
        monkeypatch.setattr(torch.version, "cuda", torchs)
        return asked

    return seem


def test_a_cpu_build_of_torch_is_named(built):
    built(torchs=None)
    assert "is a CPU build" in str(cuda_ext.why_not())


@pytest.mark.parametrize(
    ("driver", "words"),
    [
        (0, "there is no NVIDIA driver"),
        (12040, "the driver knows CUDA 12.4, the CUDA extension was built with 13.0; update the driver"),
        (13010, "torch finds no usable GPU (the driver on your system is too old); check `nvidia-smi`"),
    ],
)
def test_a_missing_or_wrong_driver_is_named(built, monkeypatch, driver, words):
    def init():
        raise RuntimeError("the driver on your system is too old. Please update it.")

    built(driver=driver)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.cuda, "init", init)
    assert words in str(cuda_ext.why_not())


def test_a_machine_that_can_run_it_is_asked_once(built, monkeypatch):
    asked = built(runtime=12040)
    monkeypatch.setattr(cuda_ext, "_could_run", [])
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


def test_a_module_that_does_not_load_asks_to_be_built_again(built, monkeypatch):
    def fails():
        raise ImportError("undefined symbol")

    built()
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


@pytest.mark.parametrize("content", ["#!/bin/sh\nexit 0\n", "no program"])
def test_an_nvcc_that_does_not_answer_is_an_error_of_the_build(tmp_path, content):
    (tmp_path / "nvcc").write_text(content)
    (tmp_path / "nvcc").chmod(0o755)
    with pytest.raises(BuildError, match="set CUDACXX to the path of an nvcc that works"):
        build_module._architectures("sm_90", str(tmp_path / "nvcc"))


def test_machine_code_is_made_for_each_architecture_and_ptx_for_the_newest(monkeypatch):
    monkeypatch.setattr(build_module, "nvcc_version", lambda nvcc: (13, 0))
    assert build_module._architectures(["sm_90", "sm_75", "80"], "nvcc") == ["75-real", "80-real", "90"]


def test_a_failing_compiler_is_quoted():
    with pytest.raises(BuildError, match="compiling the CUDA extension failed") as error:
        build_module._run("compiling", [sys.executable, "-c", "import sys; print('its words'); sys.exit(3)"])
    assert "its words" in str(error.value)


def test_rasterization_refuses_what_it_does_not_support_and_names_what_is_wrong(monkeypatch):
    ones = {"quats": (1, 4), "scales": (1, 3), "opacities": (1,), "colors": (1, 3)}
    rows = {"means": torch.zeros(1, 3), **{name: torch.ones(shape) for name, shape in ones.items()}}
    rows |= {"viewmats": torch.eye(4)[None], "Ks": torch.eye(3)[None], "width": 4, "height": 4}
    monkeypatch.setattr(backends.cuda_ext, "why_not", lambda: None)
    with pytest.raises(NotImplementedError, match=r"covars=.* by backend 'cuda': the kernels start from quats"):
        rasterization(**rows, covars=torch.zeros(1, 3, 3))
    with pytest.raises(ValueError, match="render_mode"):
        rasterization(**rows, render_mode="normals")
    with pytest.raises(ValueError, match="width is 0"):
        rasterization(**{**rows, "width": 0})
    with pytest.raises(ValueError, match=r"means is on cpu; backend 'cuda' reads cuda: use means\.cuda\(\)"):
        rasterization(**rows)


def test_the_signature_is_the_cpus():
    assert inspect.signature(rasterization) == inspect.signature(on_every_backend)


def test_the_laws_of_antialiased_mode_judge_every_kind_of_the_cuda_backend():
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
    assert offenders(check(["sm_75"], only="blend")) == []


# Room for instances follows the need: no overflow at once, no memory kept for a phase that is over, no thrashing.

BIG, SMALL = (1000, 800), (500, 400)


def drawn(capacity, counts):
    for view, count in enumerate(counts):
        capacity.note(view, count)


def of_one_view(instances: int) -> Capacity:
    """Return what is known after a step of 1,000 Gaussians had so many instances."""
    capacity = Capacity([BIG])
    capacity.settle(1000)
    capacity.note(0, instances)
    return capacity


def test_the_first_room_is_a_guess_and_never_nothing():
    capacity = Capacity([BIG])
    capacity.settle(1000)
    assert capacity.room(BIG) == 8000
    nobody = Capacity([BIG])
    nobody.settle(0)
    assert nobody.room(BIG) == 1024


def test_after_a_phase_of_fat_splats_the_room_shrinks_to_what_is_needed():
    capacity = Capacity([BIG] * 3)
    capacity.settle(1000)
    assert capacity.overflowed(1, 90_000) == BIG
    assert capacity.room(BIG) == pytest.approx(GROWTH * 90_000, abs=1)
    drawn(capacity, [2000, 3000, 1000])
    assert capacity.room(BIG) == pytest.approx(GROWTH * 90_000, abs=1)
    capacity.settle(1000)
    assert capacity.room(BIG) == pytest.approx(GROWTH * 3000, abs=1)


def test_the_heaviest_view_counts_although_the_last_window_passed_it_by():
    capacity = Capacity([BIG] * 3)
    capacity.settle(1000)
    capacity.room(BIG)
    drawn(capacity, [2000, 9000, 1000])
    for _ in range(5):
        capacity.note(0, 2000)
        capacity.settle(1000)
    assert capacity.room(BIG) >= 9000 * 1.2


def test_a_need_that_varies_a_little_moves_no_memory():
    capacity = of_one_view(10_000)
    capacity.settle(1000)
    rooms = set()
    for count in (10_500, 9500, 11_000, 8000, 12_000, 10_000) * 5:
        capacity.note(0, count)
        capacity.settle(1000)
        rooms.add(capacity.room(BIG))
        assert capacity.room(BIG) >= 1.2 * count
    assert len(rooms) == 1


def test_a_population_that_doubles_has_room_before_it_overflows():
    capacity = of_one_view(10_000)
    capacity.settle(2000)
    assert capacity.room(BIG) >= 20_000 * 1.2


def test_a_room_that_would_overflow_soon_grows_before_it_does():
    capacity = of_one_view(10_000)
    capacity.overflowed(0, 10_000)
    capacity.note(0, 14_900)
    capacity.settle(1000)
    assert capacity.room(BIG) == pytest.approx(GROWTH * 14_900, abs=1)


def test_every_size_has_a_room_of_its_own_and_a_new_size_is_judged_by_its_pixels():
    capacity = Capacity([BIG, BIG, SMALL])
    capacity.settle(1000)
    capacity.room(BIG)
    drawn(capacity, [40_000, 20_000])
    capacity.settle(1000)
    assert capacity.room(BIG) == pytest.approx(GROWTH * 40_000, abs=1)
    assert capacity.room(SMALL) == pytest.approx(GROWTH * 10_000, abs=1)
    assert capacity.overflowed(2, 30_000) == SMALL
    assert capacity.room(SMALL) == pytest.approx(GROWTH * 30_000, abs=1)
    assert capacity.room(BIG) == pytest.approx(GROWTH * 40_000, abs=1)


def test_a_need_beyond_the_kernels_numbers_stays_what_it_is_and_one_below_gets_what_there_is():
    capacity = Capacity([BIG])
    capacity.settle(1000)
    capacity.overflowed(0, MOST - 5)
    assert capacity.room(BIG) == MOST
    capacity.overflowed(0, 2**31 - 1)
    assert capacity.room(BIG) == 2**31 - 1


def test_what_a_doubled_population_may_need_is_not_refused_before_it_is_needed():
    capacity = of_one_view(MOST - 5)
    capacity.settle(2000)
    assert capacity.room(BIG) == MOST


# What captures steps and fetches flags, with a recorder in torch's place: order, errors, the collector.


class Recorder:
    """Stands in for the parts of `torch.cuda` that are used, and notes what is asked of them."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.stream = self._stream("here")
        self.fails_at_end: Exception | None = None

    def _stream(self, name):
        return SimpleNamespace(name=name, wait_stream=lambda other: self.asked.append(f"{name} waits for {other.name}"))

    def current_stream(self, device):
        return self.stream

    def Stream(self, device):
        return self._stream("aside")

    @contextmanager
    def in_stream(self, stream):
        before, self.stream = self.stream, stream
        try:
            yield
        finally:
            self.stream = before

    def CUDAGraph(self):
        def begin(capture_error_mode):
            self.asked.append(f"begin in {self.stream.name}, {capture_error_mode}")

        def end():
            self.asked.append(f"end in {self.stream.name}")
            if self.fails_at_end is not None:
                raise self.fails_at_end

        return SimpleNamespace(capture_begin=begin, capture_end=end, replay=lambda: self.asked.append("replay"))


@pytest.fixture
def cuda(monkeypatch):
    recorder = Recorder()
    for name in ("current_stream", "Stream", "CUDAGraph"):
        monkeypatch.setattr(torch.cuda, name, getattr(recorder, name))
    monkeypatch.setattr(torch.cuda, "stream", recorder.in_stream)
    return recorder


def test_a_step_is_captured_aside_and_replayed_where_it_is_asked_for(cuda):
    def launch():
        cuda.asked.append(f"launch in {cuda.stream.name}")

    again = captured(launch, torch.device("cuda"))
    assert cuda.asked == [
        "aside waits for here",
        "begin in aside, thread_local",
        "launch in aside",
        "end in aside",
        "here waits for aside",
    ]
    again()
    assert cuda.asked[-1] == "replay"


def test_no_older_graph_is_collected_while_one_is_captured(cuda):
    class Older:
        def __del__(self):
            cuda.asked.append("freed")

    older = Older()
    older.cycle = older
    del older
    was_on: list[bool] = []

    def launch():
        was_on.append(gc.isenabled())
        # enough new containers for the collector to start, if it were on
        [[] for _ in range(100_000)]

    gc.enable()
    captured(launch, torch.device("cuda"))
    assert was_on == [False]
    assert gc.isenabled()
    middle = cuda.asked[cuda.asked.index("begin in aside, thread_local") : cuda.asked.index("end in aside")]
    assert "freed" not in middle


def test_the_first_of_two_errors_is_told_with_what_to_do(cuda):
    cuda.fails_at_end = RuntimeError("operation failed due to a previous error during capture")

    def launch():
        raise RuntimeError("CUDA: cudaMalloc is not permitted when stream is capturing")

    with pytest.raises(RuntimeError, match=r"cannot be captured.*cudaMalloc is not permitted.*replay=False"):
        captured(launch, torch.device("cuda"))
    assert cuda.asked[-1] == "end in aside"
    assert gc.isenabled()
    assert cuda.stream.name == "here"


def test_flags_come_in_the_order_of_the_steps_and_no_copy_is_overwritten_before_it_is_read(monkeypatch):
    waited: list[int] = []

    class Event:
        def __init__(self):
            self.number = len(events)
            events.append(self)

        def record(self, stream):
            assert stream == "the state's"

        def synchronize(self):
            waited.append(self.number)

    events: list[Event] = []
    empty = torch.empty
    monkeypatch.setattr(torch, "empty", lambda shape, dtype, pin_memory: empty(shape, dtype=dtype))
    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: "the state's")
    state = torch.zeros(2, dtype=torch.int32)
    watch = Watch(state, 3)
    found = []
    for step in range(10):
        state.fill_(step)
        watch.post()
        if len(watch) == 3:
            with pytest.raises(RuntimeError, match="3 copies of the flags are on their way"):
                watch.post()
            found.append(watch.take()[0])
    while watch:
        found.append(watch.take()[0])
    assert found == list(range(10))
    assert waited == [k % 3 for k in range(10)]


@pytest.mark.parametrize(("reason", "first"), [(None, ["graph", "other"]), ("no GPU", ["other", "graph"])])
def test_graph_tests_go_first_where_there_is_a_gpu(monkeypatch, reason, first):
    def item(name, folder=FOLDER):
        return SimpleNamespace(name=name, path=folder / "test.py", get_closest_marker=lambda kind: name == kind or None)

    monkeypatch.setattr(cuda_ext, "why_not", lambda: reason)
    items = [item("other"), item("graph"), item("graph", FOLDER.parent / "emulated")]
    emulated = items[2]
    put_graphs_first(items)
    assert [each.name for each in items[:2]] == first
    assert items[2] is emulated
