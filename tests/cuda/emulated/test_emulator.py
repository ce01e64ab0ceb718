"""The emulator itself: it reads launches, and it sees what it is there to see."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from cuda_ext.host import emulate
from cuda_ext.host.emulate import FLAGS, HERE, translated
from tests.cuda.conftest import FOLDER

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


@pytest.mark.skipif(emulate.why_not() is not None, reason=str(emulate.why_not()))
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


@pytest.mark.skipif(emulate.why_not() is not None, reason=str(emulate.why_not()))
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
