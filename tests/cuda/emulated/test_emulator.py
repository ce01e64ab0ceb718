"""The emulator sees what it is there to see; what a step asks of a GPU, and what the fused step collects, under it.

A library that somebody else could have put in its place is never loaded.
"""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from collections import Counter
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch

from cuda_ext.arrays import Settings
from cuda_ext.host import emulate
from cuda_ext.host.emulate import FLAGS, HERE, translated
from cuda_ext.render.lists import WARP_TILE, make_lists, splat_struct
from cuda_ext.toolkit import find_compiler
from cuda_ext.training import train_step
from pop_fast.cuda import rasterization
from pop_fast.density.passes import Passes
from pop_fast.train.steps import Phase
from pop_ref.conformance.mutants.trial import every_law, law_named
from pop_ref.constants import PAPER
from tests.cuda.conftest import FOLDER, emulated_engine
from tests.cuda.gpu.scene import (
    HEIGHT,
    STEPS,
    WIDTH,
    FusedStep,
    assert_same_bits,
    drawn,
    fused_trainer,
    leaves_of,
    skip_what_is_refused,
    training_scene,
)
from tests.fast.test_passes import raw_params, views

needs_compiler = pytest.mark.skipif(emulate.why_not() is not None, reason=str(emulate.why_not()))

PROGRAM = r"""
#include <cuda_runtime.h>
#include <cstdio>
#include <stdexcept>
namespace {
template <int N, bool SYNC>
__global__ void __launch_bounds__(64) turned(const int* in, int* out) {
    __shared__ int held[64];
    held[threadIdx.x] = in[threadIdx.x];
    if (SYNC) __syncthreads();
    out[threadIdx.x] = N * held[63 - threadIdx.x];
}
__global__ void torn() {
    if (threadIdx.x < 16) __syncwarp();
    else __ballot_sync(0xffffffffu, true);
}
__global__ void waiting() {
    if (threadIdx.x == 0) __shfl_sync(1u, 0, 3);
}
}
template <class Run>
const char* tried(Run run) {
    static std::string words;
    try { run(); } catch (const std::runtime_error& error) { words = error.what(); return words.c_str(); }
    return "nothing";
}
int main() {
    int in[64], out[64] = {}, right = 0, wrong = 0;
    for (int trial = 0; trial < 20; ++trial) {
        for (int k = 0; k < 64; ++k) in[k] = 100 * trial + k;
        turned<2, true><<<1, 64, 0, nullptr>>>(in, out);
        for (int k = 0; k < 64; ++k) right += out[k] == 2 * in[63 - k];
        for (int& k : in) k += 50;
        turned<2, false><<<dim3(1), 64, 0, nullptr>>>(in, out);
        for (int k = 0; k < 64; ++k) wrong += out[k] != 2 * in[63 - k];
    }
    std::printf("%d %d\n", right == 20 * 64, wrong > 0);
    std::puts(tried([] { torn<<<1, 32, 0, nullptr>>>(); }));
    std::puts(tried([] { waiting<<<1, 32, 0, nullptr>>>(); }));
    std::puts(tried([] { waiting<<<0, 32, 0, nullptr>>>(); }));
}
"""


def test_launches_are_read_whatever_stands_in_them():
    text = "f<3, true>\n    <<<blocks_for(n, 4), dim3(a, b), 0, stream>>>(x(1, 2),\n y); g<<<1, 2, 0, s>>>();"
    assert translated(text) == (
        '::emulated::launch("f", (blocks_for(n, 4)), ( dim3(a, b)), [&] { f<3, true>(x(1, 2),\n y); }); '
        '::emulated::launch("g", (1), ( 2), [&] { g(); });'
    )


@needs_compiler
def test_a_missing_barrier_and_torn_warps_are_seen(tmp_path: Path) -> None:
    source, program = tmp_path / "program.cpp", tmp_path / "program"
    source.write_text(translated(PROGRAM))
    flags = [flag for flag in FLAGS if flag not in ("-shared", "-fPIC")]
    compiler = emulate.find_compiler()
    assert compiler is not None
    sources = [str(source), str(HERE / "emulator.cpp")]
    command = [*compiler, *flags, f"-I{HERE / 'include'}", *sources, "-o", str(program)]
    subprocess.run(command, check=True)
    done = subprocess.run([program], capture_output=True, text=True, check=True)
    right_with_a_barrier, wrong_without, *words = done.stdout.split("\n")[0].split() + done.stdout.splitlines()[1:]
    assert (right_with_a_barrier, wrong_without) == ("1", "1")
    assert words == [
        "the lanes of a warp meet at different warp functions",
        "a value is read from a lane that does not take part",
        "a launch of no threads",
    ]


@needs_compiler
def test_what_was_compiled_is_not_among_the_sources_of_what_is(monkeypatch: pytest.MonkeyPatch) -> None:
    def name_of_library() -> str:
        # one that seems to be there is not compiled
        return emulate.build(FOLDER).parent.name

    monkeypatch.setattr(Path, "exists", lambda path: path.name == "_kernels.so")
    first = name_of_library()
    leftover = FOLDER / "a_leftover" / "kernels.cu"
    leftover.parent.mkdir(parents=True)
    leftover.write_text("// of an earlier build\n")
    try:
        assert name_of_library() == first
    finally:
        leftover.unlink()
        leftover.parent.rmdir()


POP = Phase(3, True, True, True)
SORTS_AND_SCANS = {"DeviceRadixSort", "DeviceScan", "memset"}


def nodes_of_a_step(gpu, phase, **settings):
    _, trainer = fused_trainer(training_scene(), gpu, **settings)
    trainer.run(1, phase)
    emulate.nodes(emulate.build(FOLDER))
    trainer.run(2, phase)
    return emulate.nodes(emulate.build(FOLDER))


def test_a_step_is_few_kernels_each_launched_once(gpu):
    found = nodes_of_a_step(gpu, POP)
    own = {name: times for name, times in found.items() if name not in SORTS_AND_SCANS}
    assert set(own.values()) == {1}
    # with 22 of sorts and scan, whatever a photograph's size: it was 44 with clears, a total and a packing of their own
    assert len(own) <= 15, sorted(own)
    # nothing is cleared by a launch of its own: all memsets are those of the sorts, of depths by 32 bits, and of the
    # scene's 15 tiles by 4
    assert found["memset"] == (2 + 4) + (2 + 1)
    assert found["DeviceRadixSort"] == (2 + 4) + (2 + 1)
    assert found["DeviceScan"] == 2
    # a step without dominance does not count importance
    assert "count_important_kernel" not in nodes_of_a_step(gpu, Phase(3, False, False, False))


def test_a_step_is_captured_when_its_kind_comes_again_and_once(gpu, monkeypatch):
    captured, captures = train_step.captured, []

    def counting(launch, device):
        captures.append(launch)
        return captured(launch, device)

    monkeypatch.setattr(train_step, "captured", counting)
    scene = training_scene()
    # three views of three sizes: a kind is a size and a phase
    scene.photographs = [image[: HEIGHT - k, : WIDTH - k].contiguous() for k, image in enumerate(scene.photographs)]
    (params, m, v), trainer = fused_trainer(scene, gpu)
    trainer.run(3, POP)
    assert len(captures) == 0
    trainer.run(4, POP)
    assert len(captures) == 1
    trainer.run(7, POP)
    assert len(captures) == 3
    trainer.rebind(params, m, v)
    trainer.run(STEPS, POP)
    assert len(captures) == 3
    assert Counter(map(scene.order[7:].count, range(3))) == {1: 3}


@pytest.fixture
def guarded(gpu, monkeypatch):
    """Fail on a launch outside of `torch.cuda.device_of(a tensor)`, as a launch on another GPU would."""
    kernels, depth = sys.modules["cuda_ext._kernels"], []

    @contextmanager
    def device_of(tensor):
        assert isinstance(tensor, torch.Tensor)
        depth.append(tensor)
        yield
        depth.pop()

    class Guarded:
        def __getattr__(self, name):
            found = getattr(kernels, name)
            if not callable(found) or isinstance(found, type) or name in emulate.QUERIES:
                return found

            def launch(*arguments):
                assert depth, f"{name} is launched on whatever device is current"
                return found(*arguments)

            return launch

    monkeypatch.setitem(sys.modules, "cuda_ext._kernels", Guarded())
    monkeypatch.setattr(torch.cuda, "device_of", device_of)
    return gpu


def test_fused_steps_are_launched_on_the_tensors_device(guarded):
    for replay in (True, False):
        _, trainer = fused_trainer(training_scene(), guarded, replay=replay)
        trainer.run(STEPS, POP)


def test_a_render_and_its_gradients_are_launched_on_the_tensors_device(guarded):
    scene = training_scene()
    leaves = leaves_of(scene.params, guarded)
    image, _, meta = drawn(rasterization, leaves, scene, 0, [0])
    image.sum().backward()
    assert bool(leaves["means"].grad.any())
    for key in ("isect_offsets", "n_traversed", "dominant_counts"):
        assert meta[key] is not None


def test_passes_are_launched_on_the_tensors_device(guarded):
    made = Passes("cuda", views(torch.float32), device=guarded)
    params = raw_params(dtype=torch.float32)
    assert bool(made.contributions(params, 0, 3, torch.ones(made.photo(0).shape[:2])).map_sum.any())
    assert bool(made.sensitivities(params, 0, 3).any())
    assert bool(made.fisher(params, 0, 3).any())
    assert bool((made.dominant_points(params, 0, 3)[1] >= 0).any())


# What the blend does besides blending.

BIN_WIDTH = 8  # lists whose lengths differ by less may stand in any order


def corner_lists(n: int):
    # all in one corner, so that lists there are long and most others empty
    g = torch.Generator().manual_seed(n)
    rows = {
        "means2d": 30.0 * torch.rand((n, 2), generator=g) ** 2,
        "depths": 1.0 + torch.rand((n,), generator=g),
        "conics": torch.tensor([[0.02, 0.0, 0.02]]).repeat(n, 1),
        "opacities": torch.full((n,), 0.5),
        "radii": torch.full((n, 2), 22, dtype=torch.int32),
    }
    settings = Settings(90, 50, PAPER, PAPER.tile_size)
    return make_lists(settings, splat_struct(**rows, colors=None), n, torch.device("cpu"), WARP_TILE, True)


@pytest.mark.parametrize("n", [1, 60, 300])
def test_tiles_are_taken_longest_list_first_and_each_once(gpu, n):
    lists = corner_lists(n)
    order, begin, end = (lists.tensor(name).long() for name in ("tile_order", "tile_begin", "tile_end"))
    assert sorted(order.tolist()) == list(range(lists.n_tiles))
    lengths = (end - begin)[order] // BIN_WIDTH
    assert lengths.tolist() == sorted(lengths.tolist(), reverse=True)
    assert n == 1 or lengths[0] > lengths[-1]


def told(gpu, counts: bool):
    (params, _, _), trainer = fused_trainer(training_scene(), gpu, steps=2, replay=False, counts=counts)
    trainer.run(2, Phase(0, True, True, True))
    ((_, maps),) = trainer.render_stats().items()
    return maps, params


def test_training_tells_the_same_winners_without_the_counts(gpu):
    (lean, after), (full, after_full) = told(gpu, counts=False), told(gpu, counts=True)
    assert set(full) - set(lean) == {"n_blended", "n_traversed"}
    assert_same_bits(full, lean)
    assert (lean["dominant_ids"] >= 0).any()
    assert int(lean["dominant_counts"].sum()) == int((lean["dominant_ids"] >= 0).sum())
    assert_same_bits(after_full, after)


LAWS = [path for path, law in every_law().items() if law.needs == ("collected_statistics",)]


class EmulatedStep(FusedStep):
    """Takes the steps of a `Watch` on the emulated GPU."""

    def _engine(self, config: Any) -> Any:
        skip_what_is_refused(config)
        return emulated_engine()


@pytest.mark.parametrize("path", LAWS)
def test_the_fused_step_collects_as_the_laws_say(gpu: Any, path: str) -> None:
    law_named(path).sentence(EmulatedStep("pop_fast", "cuda", "float32"))


# Where its library lies.

ROOT = Path(__file__).parents[3]
# what a library of somebody else would do: tell that it was loaded
PLANTED = r"""
#include <stdio.h>
__attribute__((constructor)) static void loaded(void) { puts("planted"); fflush(stdout); }
"""
LOAD = """
import os
from types import SimpleNamespace
from unittest import mock
from cuda_ext.host import emulate
if {read_only}:
    emulate.os = SimpleNamespace(**{{**vars(os), "access": lambda *_: False}})
# compiling takes long, and which library is loaded is known before
emulate._compile = mock.Mock(side_effect=RuntimeError("compiling"))
emulate.loaded(emulate.build(emulate.library_folder()))
"""


@pytest.fixture
def read_only(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A package that cannot be written to, and the cache that stands in for it."""
    monkeypatch.setattr(emulate.os, "access", lambda *_: False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "pop-splatting"


def test_what_can_be_written_to_is_compiled_into() -> None:
    assert emulate.library_folder(ROOT / "tests") == ROOT / "tests" / "build"
    assert not (ROOT / "tests" / "build").exists()


def test_the_cache_is_made_for_this_user_alone(read_only: Path) -> None:
    before = os.umask(0)
    try:
        assert emulate.library_folder() == read_only
    finally:
        os.umask(before)
    assert stat.S_IMODE(read_only.stat().st_mode) == 0o700
    (read_only / "ours.so").write_bytes(b"")
    assert emulate.library_folder() == read_only


def test_a_cache_that_is_not_absolute_is_not_taken(
    read_only: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", "here")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert emulate.library_folder() == tmp_path / "home" / ".cache" / "pop-splatting"


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777, 0o701, 0o750])
def test_a_cache_that_is_open_to_others_is_refused(read_only: Path, mode: int) -> None:
    read_only.mkdir(parents=True)
    read_only.chmod(mode)
    words = rf"pop-splatting: is open to others \(mode {mode:o}\), so nothing is loaded"
    with pytest.raises(RuntimeError, match=words):
        emulate.library_folder()


@pytest.mark.parametrize("what", ["the folder", "a file"])
def test_what_belongs_to_somebody_else_is_refused(read_only: Path, what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    read_only.mkdir(parents=True, mode=0o700)
    path = read_only if what == "the folder" else read_only / "emulated_0123456789abcdef"
    if what == "a file":
        path.write_bytes(b"")
    real = Path.lstat

    def lstat(self: Path) -> os.stat_result:
        found = list(real(self))
        found[stat.ST_UID] += 1 if self == path else 0
        return os.stat_result(found)

    monkeypatch.setattr(Path, "lstat", lstat)
    with pytest.raises(RuntimeError, match=rf"{path.name}: belongs to user {os.geteuid() + 1}, not to you"):
        emulate.library_folder()


def test_a_link_is_refused(read_only: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    read_only.parent.mkdir()
    read_only.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RuntimeError, match="pop-splatting: is a link"):
        emulate.library_folder()


def plant(folder: Path, tmp_path: Path) -> None:
    """Compile a library that is not ours under the name of the emulated kernels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(emulate, "_compile", lambda compiler, library: None)
        library = emulate.build(folder)
    (tmp_path / "planted.cpp").write_text(PLANTED)
    subprocess.run([*(find_compiler() or []), "-shared", "-fPIC", "-o", library, tmp_path / "planted.cpp"], check=True)


def load(folder: Path, read_only: bool) -> subprocess.CompletedProcess[str]:
    """Load the emulated kernels in another process that has `folder` for temporary files, with a cache in it."""
    places = {"TMPDIR": str(folder), "XDG_CACHE_HOME": str(folder / "cache"), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", LOAD.format(read_only=read_only)]
    return subprocess.run(command, env=os.environ | places, capture_output=True, text=True, check=False, cwd=folder)


@needs_compiler
def test_a_library_in_the_folder_for_temporary_files_is_not_loaded(tmp_path: Path) -> None:
    plant(tmp_path / "emulated", tmp_path)
    assert "planted" not in load(tmp_path, read_only=False).stdout
    assert "planted" not in load(tmp_path, read_only=True).stdout


@needs_compiler
def test_a_library_in_a_cache_that_is_open_to_others_is_not_loaded(tmp_path: Path) -> None:
    cache = tmp_path / "cache" / "pop-splatting"
    plant(cache, tmp_path)
    cache.chmod(0o777)
    done = load(tmp_path, read_only=True)
    assert "planted" not in done.stdout
    assert done.returncode != 0
    assert done.stderr.splitlines()[-1].startswith(f"RuntimeError: {cache}: is open to others (mode 777)")
    # one's own is
    cache.chmod(0o700)
    assert "planted" in load(tmp_path, read_only=True).stdout
