"""Machine code: the parser on a fragment, samples laid on the lines of a source, floors that follow from counts."""

from dataclasses import replace
from pathlib import Path

import pytest

from cuda_ext.machine_code import hot_lines
from cuda_ext.machine_code.hot_lines import parse_sass

# nvdisasm -c -gi of a loop that adds where a pixel is hit
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
	//## File "/somewhere/a.cu", line 3
        /*00a0*/                   LDS.128 R16, [R22] ;
        /*00c0*/               @P0 BRA `(.L_x_5) ;
        /*00f0*/               @P0 FFMA R6, R15, R22.reuse, R6 ;
.L_x_5:
	//## File "/somewhere/a.cu", line 2
        /*0120*/              @!P0 BRA `(.L_x_1) ;
        /*0130*/                   STG.E desc[UR4][R16.64+0x4], R41 ;
        /*0180*/                   BRA `(.L_x_10);
"""


def test_source_lines_are_read_with_what_they_were_inlined_into() -> None:
    (code,) = parse_sass(FRAGMENT)
    opcodes = "S2R ISETP.GE.AND EXIT LOP3.LUT LDS.128 BRA FFMA BRA STG.E BRA"
    assert [one.opcode for one in code.instructions] == opcodes.split()
    assert code.instructions[0].frames == (("a.cuh", 4), ("a.cu", 1))
    assert code.instructions[3].frames == (("a.cu", 2),)


def test_the_notes_hold_what_counts_and_measurements_give(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "benchmarks"))
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


# What a profile says of every instruction, laid on the source's lines.


def profile_of(instructions, samples):
    """Return the page of sources as ncu prints it, its table twice as ncu does."""
    head = ["Address", "Source", "# Samples", "Instructions Executed", "stall_long_sb", "stall_wait"]
    head += ["stall_wait (Not Issued)"]
    rows = []
    for k, (one, n) in enumerate(zip(instructions, samples, strict=True)):
        source = f"@!P0 {one.opcode}  R1" if k % 2 else f"      {one.opcode} R1"
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


def test_a_profile_that_is_none_and_a_missing_tool_are_told_in_a_line(tmp_path, capsys, monkeypatch):
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
    monkeypatch.setattr(hot_lines, "find_nvcc", lambda: "nvcc")
    monkeypatch.setattr(hot_lines, "find_nvdisasm", lambda: None)
    assert hot_lines.main([str(path), "--kernel", "blend"]) == 1
    assert f"hot_lines: {path}: nvdisasm was not found; install" in capsys.readouterr().err
    monkeypatch.setattr(hot_lines, "find_nvcc", lambda: None)
    assert hot_lines.main([str(path), "--kernel", "blend"]) == 1
    assert capsys.readouterr().err == f"hot_lines: {path}: {hot_lines.NO_NVCC}\n"
