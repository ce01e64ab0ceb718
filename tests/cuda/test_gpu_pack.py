"""What travels to a bare node: every file listed, under the limit, and what cannot be packed told."""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from pop_fast.data import load_capture
from tests.app.captures import colmap_capture

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def pack(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import gpu_pack

    def packed(folder: Path, *words: str) -> int:
        monkeypatch.setattr(sys, "argv", ["gpu_pack", str(folder), "--no-wheels", *words])
        return gpu_pack.main()

    packed.module = gpu_pack
    return packed


def test_a_packed_capture_is_the_capture_shrunk(pack, tmp_path):
    source = colmap_capture(tmp_path / "scene")
    assert pack(tmp_path / "pack", "--captures", str(source), "--pixels", "200") == 0
    before, after = (load_capture(path, normalize=False) for path in (source, tmp_path / "pack" / "captures" / "scene"))
    assert len(after.views) == len(before.views)
    np.testing.assert_allclose(after.points, before.points, rtol=1e-5)
    assert np.array_equal(after.points_rgb, before.points_rgb)
    for ours, theirs in zip(after.views, before.views, strict=True):
        assert ours.width * ours.height < 230 < theirs.width * theirs.height
        np.testing.assert_allclose(ours.viewmat, theirs.viewmat, atol=1e-12)
        # what a pixel of the photograph sees, one of the shrunk one sees too
        np.testing.assert_allclose(ours.K[0] / ours.width, theirs.K[0] / theirs.width, rtol=1e-12)
        np.testing.assert_allclose(ours.K[1] / ours.height, theirs.K[1] / theirs.height, rtol=1e-12)
        assert abs(float(ours.image.mean()) - float(theirs.image.mean())) < 8.0


def test_every_file_is_listed_with_its_digest(pack, tmp_path):
    folder = tmp_path / "pack"
    assert pack(folder, "--captures", str(colmap_capture(tmp_path / "scene"))) == 0
    manifest = json.loads((folder / "manifest.json").read_text())
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != "manifest.json"]
    assert sorted(manifest["files"]) == sorted(path.relative_to(folder).as_posix() for path in files)
    for path in files:
        entry = manifest["files"][path.relative_to(folder).as_posix()]
        assert entry == {"bytes": path.stat().st_size, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    assert manifest["packed_bytes"] == sum(path.stat().st_size for path in files)
    assert manifest["repository_bytes"] > 1_000_000


def test_what_cannot_be_packed_is_told_and_the_rest_is_packed(pack, tmp_path, capsys):
    folder = tmp_path / "pack"
    words = ["--runs", str(tmp_path / "nothing"), "--captures", str(colmap_capture(tmp_path / "scene"))]
    assert pack(folder, *words) == 1
    told = json.loads((folder / "manifest.json").read_text())["absent"]
    assert len(told) == 1
    assert "nothing" in told[0]
    assert told[0] in capsys.readouterr().err
    assert (folder / "captures" / "scene" / "images" / "0001.jpg").is_file()


def test_a_pack_that_is_too_large_is_refused_and_no_other_folder_touched(pack, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pack.module, "LIMIT", 1000)
    assert pack(tmp_path / "pack") == 1
    assert "too much to travel" in capsys.readouterr().err
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years")
    assert pack(tmp_path / "mine") == 2
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "years"
    assert "holds files that no pack has" in capsys.readouterr().err
