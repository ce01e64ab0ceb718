"""The tables against each other and its text: every check is as it is said to be, and a wrong one fails."""

from __future__ import annotations

from pathlib import Path

import pytest

from paper_repro.checks import Check, checks, places
from paper_repro.paper import PAPER, load, paper

CHECKS = checks(paper())


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.says)
def test_it_holds_or_fails_for_a_known_reason(check: Check) -> None:
    assert check.holds == (check.known == ""), check.found


def test_what_is_known_not_to_hold_is_little_and_named() -> None:
    assert len([check for check in CHECKS if check.known]) == 7
    assert len(CHECKS) == len({check.says for check in CHECKS}) == 129


CHANGES = [
    ("[3168, 886, 713,", "[3168, 886, 750,", "table 1, Mip-NeRF 360, gsplat: Ckpt is Num x 236 bytes"),
    ('236 = ["gsplat", "pop"]', '236 = ["pop"]\n252 = ["gsplat"]', "table 1, Mip-NeRF 360, gsplat: Ckpt"),
    ("[268, 279, 27.01, 0.760, 0.277]", "[268, 279, 27.02, 0.760, 0.277]", "pop, Mip-NeRF 360: psnr is the same"),
    ("marks = [0, 0, 0, 2, 1, 2]", "marks = [0, 0, 0, 2, 1, 0]", "table 1, Mip-NeRF 360, lpips: the best 3 are marked"),
    ("[318, 305, 75,", "[318, 290, 75,", "POP saves at least 30%"),
    ("[562, 358, 27.17,", "[562, 358, 27.18,", "the window 3k-15k changes PSNR by +0.16 dB"),
    ("[562, 358,", "[962, 358,", "the window 3k-15k takes 2 to 3 times the Gaussians of 3k-7k on Mip-NeRF 360"),
    ("[279, 728, 66, 26.926,", "[279, 728, 66, 27.926,", "POP surpasses speedy_splat in PSNR"),
    ("[548, 328, 26.82,", "[548, 328, 27.82,", "POP is no worse than opacity reset in PSNR on Mip-NeRF 360"),
    ("[346, 329, 82,", "[246, 329, 82,", "POP has the least num_gaussians_k on Mip-NeRF 360"),
]


@pytest.mark.parametrize(("old", "new", "says"), CHANGES, ids=[says for _, _, says in CHANGES])
def test_a_changed_number_is_noticed(old: str, new: str, says: str, tmp_path: Path) -> None:
    text = PAPER.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "paper.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    broken = [check.says for check in checks(load(path)) if not check.holds and not check.known]
    assert any(told.startswith(says) for told in broken), broken


def test_equal_values_share_a_place_and_use_up_the_next() -> None:
    least, most = paper().metrics["ckpt_mb"], paper().metrics["psnr"]
    assert places({"a": 43.0, "b": 43.0, "c": 48.0, "d": 60.0}, least, 3) == {"a": 1, "b": 1, "c": 3, "d": 0}
    assert places({"a": 1.0, "b": 3.0, "c": 2.0}, most, 1) == {"a": 0, "b": 1, "c": 0}
    assert places({}, most, 3) == {}
