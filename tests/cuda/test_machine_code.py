"""Instruction counts from machine code: the parser on a fragment whose counts are plain to see; the committed file."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from cuda_ext.machine_code import count_sass, hot_lines
from cuda_ext.machine_code.check_ptxas import CSRC, KernelUse
from cuda_ext.machine_code.count_sass import (
    CLASSES,
    PROCESSORS,
    Flow,
    class_of,
    find_loops,
    find_nvdisasm,
    kernel_entry,
    loop_line,
    outside_loops,
    parse_sass,
    warps_per_processor,
)
from cuda_ext.toolkit import find_nvcc

COUNTS = Path(__file__).resolve().parents[2] / "benchmarks" / "results" / "sass.json"
# nvdisasm -c -gi of a loop that looks every so often whether to stop, and adds where a pixel is hit
FRAGMENT = """
	.section	.text._ZN3pop20blend_forward_kernelE,"ax",@progbits
.text._ZN3pop20blend_forward_kernelE:
	//## File "/somewhere/a.cuh", line 4 inlined at "/somewhere/a.cu", line 1
	//## File "/somewhere/a.cu", line 1
        /*0000*/                   S2R R0, SR_TID.X ;
        /*0010*/                   ISETP.GE.AND P1, PT, R0, 0x4, PT ;
        /*0020*/               @P1 EXIT ;
.L_x_1:
	//## File "/somewhere/a.cu", line 2
        /*0030*/                   LOP3.LUT P0, RZ, R20, 0x7, RZ, 0xc0, !PT ;
        /*0040*/                   BSSY B2, `(.L_x_3) ;
        /*0050*/               @P0 BRA `(.L_x_2) ;
        /*0060*/                   BRA.DIV UR6, `(.L_x_9) ;
        /*0070*/                   VOTE.ANY P0, P0 ;
.L_x_8:
        /*0080*/              @!P0 BRA `(.L_x_7) ;
.L_x_2:
        /*0090*/                   BSYNC B2 ;
.L_x_3:
	//## File "/somewhere/a.cu", line 3
        /*00a0*/                   LDS.128 R16, [R22] ;
        /*00b0*/                   FFMA R18, R12, R51, R23 ;
        /*00c0*/               @P0 BRA `(.L_x_5) ;
        /*00d0*/                   MUFU.EX2 R22, -R51 ;
        /*00e0*/                   FMUL R22, R13, R22 ;
        /*00f0*/               @P0 FFMA R6, R15, R22.reuse, R6 ;
.L_x_5:
	//## File "/somewhere/a.cu", line 2
        /*0100*/                   VIADD R20, R20, 0x1 ;
        /*0110*/                   ISETP.GE.AND P0, PT, R20, R21, PT ;
        /*0120*/              @!P0 BRA `(.L_x_1) ;
.L_x_7:
        /*0130*/                   STG.E desc[UR4][R16.64+0x4], R41 ;
        /*0140*/                   NOP ;
        /*0150*/                   EXIT ;
.L_x_9:
        /*0160*/                   WARPSYNC.COLLECTIVE R12, `(.L_x_8) ;
        /*0170*/                   BRA `(.L_x_8) ;
.L_x_10:
        /*0180*/                   BRA `(.L_x_10);
"""
SOURCES = {"a.cu": ["__global__ void f() {", "for (;;) {  // per record", "} }"]}


def test_a_loop_is_counted_by_what_is_always_issued_and_what_may_be_skipped() -> None:
    (code,) = parse_sass(FRAGMENT)
    flow = Flow(code)
    (loop,) = find_loops(flow)
    assert loop.always == {"integer": 2, "branch": 5, "shared": 1, "float": 1, "compare": 1}
    # the path of diverged warps is nowhere: neither WARPSYNC nor the jump back
    assert {(r.kind, sum(r.counts.values())) for r in loop.regions} == {("look", 3), ("exponential", 3)}
    assert sum(loop.total.values()) == 16
    assert loop.exponentials == 1
    assert outside_loops(flow, [loop]) == {"move": 1, "compare": 1, "branch": 2, "global": 1}
    assert loop_line(loop, SOURCES) == ("a.cu", 2, "for (;;) {  // per record")


def test_source_lines_are_read_with_what_they_were_inlined_into() -> None:
    (code,) = parse_sass(FRAGMENT)
    assert code.instructions[0].frames == (("a.cuh", 4), ("a.cu", 1))
    assert code.instructions[3].frames == (("a.cu", 2),)


def test_an_entry_names_its_loops_and_the_kernel() -> None:
    (code,) = parse_sass(FRAGMENT)
    use = KernelUse("a.cu", "blend_forward_kernel<3, false, false>", "sm_90", 56, 6144, 0, 0, 0)
    entry = kernel_entry(code, use, SOURCES)
    assert (entry["per"], entry["warps"], entry["outside_loops"]) == ("tile", 36, 5)
    (loop,) = entry["loops"]
    assert (loop["per"], loop["loop"], loop["iterations"]) == ("record", "a.cu: for (;;)", 1)
    with pytest.raises(RuntimeError, match=r"a\.cu: add other_kernel to"):
        kernel_entry(code, KernelUse("a.cu", "other_kernel", "sm_90", 1, 0, 0, 0, 0), SOURCES)


OPCODES = {
    "REDUX.MAX": "vote",
    "RED.E.ADD": "global",
    "LDC.64": "constant",
    "LDG.E": "global",
    "STS.128": "shared",
    "ULDC": "uniform",
    "SHFL.BFLY": "shuffle",
    "SHF.L.U32": "integer",
    "IMAD.MOV.U32": "multiply",
    "Q": "other",
}


@pytest.mark.parametrize(("opcode", "name"), OPCODES.items())
def test_classes(opcode: str, name: str) -> None:
    assert class_of(opcode) == name
    assert name in CLASSES


def test_warps_that_fit() -> None:
    hopper = PROCESSORS["sm_90"]
    # registers: 64 x 32 a warp, 65,536 in all; shared memory: 1 KiB a block is the system's; the most there are
    assert warps_per_processor(64, 0, 128, hopper) == 32
    assert warps_per_processor(120, 17920, 128, hopper) == 16
    assert warps_per_processor(16, 45 << 10, 128, hopper) == 16
    assert warps_per_processor(16, 0, 128, hopper) == 64


def test_what_is_missing_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    monkeypatch.setattr("sys.argv", ["count_sass"])
    monkeypatch.setattr(count_sass, "find_nvcc", lambda: "nvcc")
    monkeypatch.setattr(count_sass, "find_nvdisasm", lambda: None)
    assert count_sass.main() == 2
    told = r"count_sass: nvdisasm was not found; install .*'pop-splatting\[sass\]'.*\n"
    assert re.fullmatch(told, capsys.readouterr().err)
    monkeypatch.setattr(count_sass, "find_nvcc", lambda: None)
    assert count_sass.main() == 2
    assert capsys.readouterr().err == f"count_sass: {count_sass.NO_NVCC}\n"


def test_every_kernel_of_the_sources_is_committed_for_both_architectures() -> None:
    told = json.loads(COUNTS.read_text())["kernels"]
    files = {path.name: re.findall(r"__global__[^;{]*?(\w+_kernel)\(", path.read_text()) for path in CSRC.glob("*.cu")}
    written = {(name, kernel) for name, kernels in files.items() for kernel in kernels}
    for arch in count_sass.ARCHS:
        found = {(entry["file"], entry["kernel"].split("<")[0]) for entry in told if entry["arch"] == arch}
        assert found == written, "run 'make sass'"


def test_the_notes_say_which_sources_have_changed_since_they_were_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(COUNTS.parents[1]))
    import gpu_predictions

    told = json.loads(COUNTS.read_text()) | {"sources": count_sass.sources()}
    assert gpu_predictions.machine_code(told).endswith(f"\n\nCounted with nvcc {told['nvcc']}.")
    was = told["sources"] | {"tiles.cuh": ""}
    del was["step.cu"]
    assert "Changed since: `step.cu`, `tiles.cuh`." in gpu_predictions.machine_code(told | {"sources": was})
    assert json.loads(count_sass.as_json(told)) == told


def test_the_notes_hold_what_the_counts_give(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(COUNTS.parents[1]))
    import gpu_predictions

    assert gpu_predictions.main(["--check"]) == 0
    # twice the issue rate halves what is bound by it
    slow = gpu_predictions.floors(gpu_predictions.CASE, gpu_predictions.H200)
    card, case = gpu_predictions.H200, gpu_predictions.CASE
    fast = gpu_predictions.floors(case, replace(card, instructions_per_s=2.0 * card.instructions_per_s))
    assert fast["blend_backward"]["floor_ms"] == pytest.approx(slow["blend_backward"]["floor_ms"] / 2.0)
    # a list that is long enough bounds the blend whatever the others are
    long = gpu_predictions.floors(replace(case, longest=50_000), card)
    assert (slow["blend_forward"]["bound"], long["blend_forward"]["bound"]) == ("issue", "longest list")
    again = gpu_predictions.floors(replace(case, longest=100_000), card)
    assert again["blend_forward"]["floor_ms"] == pytest.approx(2.0 * long["blend_forward"]["floor_ms"])
    # what goes through the half-rate pipe is a part of what is issued
    for name in ("blend_forward", "blend_backward"):
        times = slow[name]["times_ms"]
        assert 0.5 * times["half rate"] < times["issue"]


@pytest.mark.slow
@pytest.mark.skipif(find_nvcc() is None or find_nvdisasm() is None, reason="no nvcc or no nvdisasm: nothing to count")
@pytest.mark.parametrize("file", ["blend_forward", "tiles"])
def test_the_committed_counts_are_those_of_the_sources(file: str) -> None:
    told = json.loads(COUNTS.read_text())
    nvcc, nvdisasm = find_nvcc(), find_nvdisasm()
    assert nvcc is not None
    assert nvdisasm is not None
    found = count_sass.count(nvcc, nvdisasm, ["sm_90"], file)
    if found["nvcc"] != told["nvcc"]:
        pytest.skip(f"the counts were taken with nvcc {told['nvcc']}, this is {found['nvcc']}")
    same = [entry for entry in told["kernels"] if (entry["file"], entry["arch"]) == (f"{file}.cu", "sm_90")]
    assert found["kernels"] == same


# What a profile says of every instruction, laid on the source's lines.


def profile_of(instructions, samples):
    """Return the page of sources as ncu prints it, its table twice as ncu does."""
    head = ["Address", "Source", "# Samples", "Instructions Executed", "stall_long_sb", "stall_wait"]
    head += ["stall_wait (Not Issued)"]
    rows = []
    for k, (one, n) in enumerate(zip(instructions, samples, strict=True)):
        source = f"@{one.predicate} {one.opcode}  {one.operands}" if one.predicate else f"      {one.opcode} R1"
        rows.append([f"0x7f{k:02x}", source, n, 10, n, 0, 99])
    table = [["Kernel Name", "void pop::<unnamed>::blend_kernel<(int)3>(int)", ""], head, *rows]
    return [",".join(f'"{value}"' for value in row) for row in (*table, *table)]


def test_samples_are_added_up_by_the_lines_of_the_source():
    (code,) = parse_sass(FRAGMENT)
    samples = list(range(len(code.instructions)))
    (profiled,) = hot_lines.read_profile(profile_of(code.instructions, samples)).values()
    found = hot_lines.by_line(profiled, code.instructions)
    assert sum(line.samples for line in found.values()) == sum(samples)
    of_three = [k for k, one in enumerate(code.instructions) if one.frames[0] == ("a.cu", 3)]
    line = found["a.cu", 3]
    assert line.samples == sum(of_three) > 0
    assert line.executed == 10 * len(of_three)
    assert dict(line.stalls) == {"long_sb": sum(of_three)}
    shown = hot_lines.table(found, 1)
    assert len(shown) == 2
    assert "a.cu:" in shown[1]


def test_another_source_than_the_profiled_one_is_told():
    (code,) = parse_sass(FRAGMENT)
    (profiled,) = hot_lines.read_profile(profile_of(code.instructions, [1] * len(code.instructions))).values()
    with pytest.raises(ValueError, match=r"and number 1 differs; check out the commit that was profiled"):
        hot_lines.by_line(profiled, [code.instructions[0], *code.instructions[2:], code.instructions[1]])
    with pytest.raises(ValueError, match="instructions are compiled here"):
        hot_lines.by_line(profiled, code.instructions[:-1])


def test_a_profile_that_is_none_is_told_in_a_line(tmp_path, capsys):
    path = tmp_path / "lines.csv"
    path.write_text("no,table\n")
    assert hot_lines.main([str(path)]) == 1
    assert "there is no instruction in it" in capsys.readouterr().err
    (code,) = parse_sass(FRAGMENT)
    path.write_text("\n".join(profile_of(code.instructions, [2] * len(code.instructions))))
    assert hot_lines.main([str(path)]) == 0
    assert f"{2 * len(code.instructions)} samples  void pop" in capsys.readouterr().out
    assert hot_lines.main([str(path), "--kernel", "missing"]) == 1
    assert "0 kernels have 'missing' in their names" in capsys.readouterr().err
