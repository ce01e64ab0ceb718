"""File formats of splats: what a round trip loses, what other programs' readers see, and damaged files refused."""

from __future__ import annotations

import gzip
import importlib
import io
import itertools
import json
import re
import struct
import sys
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import zstandard
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation
from torch import Tensor

from benchmarks.faults.corpus import ksplat_of
from pop_fast.data.unpack import take_frames
from pop_fast.errors import PopError
from pop_fast.io import read_back
from pop_fast.io.formats import FORMATS, encoded, format_names, load_splat_file, loses_frame, named_format, save_as
from pop_fast.io.formats import decoded as from_bytes
from pop_fast.io.formats.cloud import SH_C0, Cloud, morton_order
from pop_fast.io.formats.compressed_ply import chunked
from pop_fast.io.formats.gltf import NAME
from pop_fast.io.formats.sog import codebook, nearest, row_palette
from pop_fast.io.images import read_image
from pop_fast.io.ply import Frame, save_ply
from pop_fast.io.read_back import check_memory, read_arrays
from pop_fast.train.load_result import load_splat
from pop_ref.covariance import covars_from_quats_scales
from pop_ref.harmonics import sh_basis
from tests.app.captures import assert_one_line, many, png_of_zeros
from tests.app.conftest import Pop, in_a_child
from tests.app.damage import says

BYTE = 0.5 / 255.0
# of degree 0, in coefficients
COLOR_BYTE = BYTE / SH_C0


def _floats(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, width=32, allow_subnormal=False)


@st.composite
def splats(draw: st.DrawFn, most: int = 6) -> dict[str, Tensor]:
    """Draw raw parameters of none to some Gaussians, of colour degree 0 to 3."""
    n, bands = draw(st.integers(0, most)), draw(st.sampled_from((0, 3, 8, 15)))

    def rows(shape: tuple[int, ...], values: st.SearchStrategy[float]) -> Tensor:
        return torch.from_numpy(draw(arrays(np.float32, shape, elements=values)))

    quats = rows((n, 4), st.sampled_from((0.0, 1.0, -1.0, 0.5, 0.0625, -3.0)))
    quats[~quats.any(1)] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    # opacities of exactly 0 and 1 in float32 among them
    logits = st.one_of(st.sampled_from((0.0, -120.0, 40.0, -5.5, 5.5)), _floats(-8.0, 8.0))
    return {
        "means": rows((n, 3), _floats(-100.0, 100.0)),
        "scales": rows((n, 3), _floats(-9.0, 5.0)),
        "quats": quats,
        "opacities": rows((n,), logits),
        "sh0": rows((n, 1, 3), _floats(-1.75, 1.75)),
        "shN": rows((n, bands, 3), _floats(-0.9375, 0.9375)),
    }


def decoded(
    name: str, params: dict[str, Tensor], antialiased: bool = False, frame: Frame | None = None
) -> tuple[Cloud, Cloud, bytes]:
    """Return what went into a file, in its order, what came out, and the file."""
    format, cloud = FORMATS[name], Cloud.of(params, antialiased, frame)
    cloud = cloud if format.order is None else cloud.take(format.order(cloud))
    data = format.encode(cloud)
    return cloud, format.decode(data, Path(f"x{format.suffix}")), data


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between rotations."""
    a, b = a.astype(np.float64), b.astype(np.float64)
    b = b * np.where((a * b).sum(1, keepdims=True) < 0.0, -1.0, 1.0)
    return np.degrees(4.0 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=1) / 2.0, 0.0, 1.0)))


def assert_within(was: np.ndarray, now: np.ndarray, bound: Any, what: str) -> None:
    excess = np.abs(was.astype(np.float64) - now) - bound
    assert not len(excess) or excess.max() <= 1e-6 * (1.0 + np.abs(was).max(initial=0.0)), what


def chunk_extent(values: np.ndarray) -> np.ndarray:
    """The extent of every row's chunk of 256 rows."""
    chunks = [values[i : i + 256] for i in range(0, len(values), 256)]
    return np.concatenate([values[:0], *(np.broadcast_to(np.ptp(chunk, axis=0), chunk.shape) for chunk in chunks)])


def bounds_of(name: str, was: Cloud) -> dict[str, Any]:
    """What the table of formats states, as numbers: of centres, log-scales, degrees, opacities, sh0 and rest."""
    if name == "gltf":
        return {"means": 0.0, "log_scales": 1e-6, "degrees": 0.001, "opacities": 1e-7, "sh0": 0.0, "rest": 0.0}
    if name == "splat":
        return {"means": 0.0, "log_scales": 1e-6, "degrees": 1.2, "opacities": BYTE, "sh0": COLOR_BYTE}
    if name in ("spz", "spz-4", "gltf-spz"):
        bits = min(20, int(np.floor(np.log2((2**23 - 1) / max(np.abs(was.means).max(initial=0.0), 1e-6)))))
        turn = 14.0 if name == "gltf-spz" else 0.28
        same = {"log_scales": 1 / 32, "opacities": BYTE, "sh0": 0.5 / 0.15 / 255.0, "rest": 0.25}
        smallest = np.exp(was.log_scales.astype(np.float64)).min(axis=1, keepdims=True, initial=np.inf)
        return {"means": np.maximum(0.5 / 2.0**bits, smallest / 16.0), "degrees": turn, **same}
    if name == "compressed-ply":
        half = 0.5 / np.array([2047.0, 1023.0, 2047.0])
        extents = {"means": half * chunk_extent(was.means), "log_scales": half * chunk_extent(was.log_scales)}
        return {**extents, "degrees": 0.28, "opacities": BYTE, "sh0": BYTE * chunk_extent(was.sh0), "rest": 1 / 64}
    log = np.sign(was.means) * np.log1p(np.abs(was.means))
    step = np.ptp(log, axis=0) / 65535.0 if len(log) else np.zeros(3)
    # d exp(|x|) over half a step, and the rounding of float32
    means = 0.5 * step * (1.0 + np.abs(was.means)) * 1.001
    return {"means": means, "degrees": 1.1, "opacities": BYTE}


@pytest.mark.parametrize("name", FORMATS)
@given(params=splats(), antialiased=st.booleans())
@example(params=many(700), antialiased=True)
@example(params=many(1, 0), antialiased=False)
@example(params=many(0), antialiased=False)
def test_a_round_trip_loses_what_is_stated_and_no_more(name: str, params: dict, antialiased: bool) -> None:
    was, now, _ = decoded(name, params, antialiased)
    bounds = bounds_of(name, was)
    if name == "compressed-ply":
        # coefficients beyond +-4 are cut off, and so are those at the last half step
        assert not was.rest.size or np.abs(was.rest).max() < 3.9
    assert len(now) == len(was)
    for field in ("means", "log_scales", "opacities", "sh0", "rest"):
        if field in bounds and getattr(was, field).size:
            limit = 0.5 / SH_C0 if (name, field) == ("splat", "sh0") else np.inf
            assert_within(np.clip(getattr(was, field), -limit, limit), getattr(now, field), bounds[field], field)
    assert not len(was) or degrees(was.quats, now.quats).max() <= bounds["degrees"]
    assert now.degree == (0 if name == "splat" else was.degree)
    assert now.antialiased == (antialiased and name != "splat")
    assert np.isfinite(now.logits).all()


def test_rotations_away_from_half_turns_lose_less_in_the_draft_of_gltf() -> None:
    was, now, _ = decoded("gltf-spz", many(4000))
    upright = np.abs(was.quats[:, 0]) > 0.3
    assert upright.sum() > 1000
    assert degrees(was.quats, now.quats)[upright].max() < 2.6


def test_a_palette_is_near_what_it_stands_for_and_keeps_few_distinct_colours() -> None:
    params = many(2000)
    was, now, _ = decoded("sog", params)
    for field, most in (("log_scales", 0.015), ("sh0", 0.005)):
        # a colour under an opacity of 0 is lost
        errors = (getattr(was, field) - getattr(now, field))[was.opacities > 1.0 / 255.0]
        assert np.sqrt((errors**2).mean()) < most
    # 500 rows for 2,000 rows of noise cannot explain much; they must explain a share, and real colours are no noise
    explained = 1.0 - ((was.rest - now.rest) ** 2).mean() / was.rest.var()
    assert explained > 0.2
    params["shN"] = many(40)["shN"].repeat(50, 1, 1)
    was, now, _ = decoded("sog", params)
    # each is a row of the palette, whose numbers are rounded to the nearest of 256, few of which are far out
    assert np.sqrt(((was.rest - now.rest) ** 2).mean()) < 0.005
    assert np.abs(was.rest - now.rest).max() < 0.03
    # every row of few is given its nearest
    rows = many(600)["shN"].reshape(600, -1).numpy()
    palette, labels = row_palette(rows, np.ones(600), 64)
    assert labels.max() < len(palette) <= 64
    assert ((rows - palette[labels]) ** 2).sum() < ((rows - rows.mean(0)) ** 2).sum()


@given(values=st.lists(st.floats(-8.0, 8.0, width=32), max_size=60))
def test_a_codebook_is_near_what_it_is_fitted_to(values: list[float]) -> None:
    numbers = np.array(values, np.float32)
    codes = codebook(numbers)
    assert len(codes) == 256
    assert (np.diff(codes) >= 0.0).all()
    span = float(np.ptp(numbers)) if len(values) else 0.0
    assert not len(values) or np.abs(codes[nearest(codes, numbers)] - numbers).max() <= span / 256.0 + 1e-4


def test_a_codebook_is_nearest_where_the_weights_are() -> None:
    numbers = np.concatenate([np.linspace(-8.0, 0.0, 5000), np.linspace(0.0, 1.0, 50)]).astype(np.float32)
    weights = np.repeat([0.001, 1.0], [5000, 50])
    books = codebook(numbers), codebook(numbers, weights)
    even, weighted = ((weights * (codes[nearest(codes, numbers)] - numbers) ** 2).sum() for codes in books)
    assert weighted < 0.5 * even


def test_a_centre_is_rounded_by_what_its_gaussian_measures() -> None:
    params = many(4000)
    was, now, data = decoded("spz", params)
    error = np.abs(was.means - now.means).max(axis=1) / np.exp(was.log_scales.min(axis=1))
    assert 0.05 < error.max() <= 1.0 / 16.0 + 1e-3
    params["scales"] -= 3.0
    assert len(decoded("spz", params)[2]) > len(data)
    # so far that few bits are left below one
    params["means"] *= 2.0**20 / params["means"].abs().max()
    was, now, _ = decoded("spz", params)
    assert np.abs(was.means - now.means).max() <= 0.125 + 1e-6


def test_the_space_filling_curve_is_a_permutation_that_keeps_neighbours_close() -> None:
    means = many(4096)["means"].numpy()
    order = morton_order(means)
    assert np.array_equal(np.sort(order), np.arange(4096))
    along, before = (np.linalg.norm(np.diff(rows, axis=0), axis=1).mean() for rows in (means[order], means))
    assert along < 0.3 * before


@pytest.mark.parametrize("n", [0, 1, 256, 257, 20_000])
def test_a_chunk_holds_what_is_close_together_however_far_away_others_are(n: int) -> None:
    params = many(n, 0)
    params["means"][::500] *= 100.0
    cloud = Cloud.of(params)
    order = chunked(cloud)
    assert np.array_equal(np.sort(order), np.arange(n))
    inner = np.abs(cloud.means[order]).max(axis=1, initial=0.0) < 10.0
    assert n < 20_000 or np.median(chunk_extent(cloud.means[order])[inner]) < 2.0


@pytest.mark.parametrize("axis", ["x", "z"])
def test_a_turned_cloud_shows_along_turned_directions_what_it_showed(axis: str) -> None:
    cloud = Cloud.of(many(50))
    turned = cloud.turned(axis)
    half_turn = np.diag([1.0 if name == axis else -1.0 for name in "xyz"])
    directions = np.random.default_rng(0).normal(size=(50, 3))
    seen = []
    for c, along in ((cloud, directions), (turned, directions @ half_turn)):
        sh = np.concatenate([c.sh0[:, None], c.rest], axis=1).astype(np.float64)
        scales = np.exp(c.log_scales.astype(np.float64))
        colors = np.einsum("nk,nkc->nc", sh_basis(along, 3), sh)
        seen.append((colors, covars_from_quats_scales(c.quats.astype(np.float64), scales)))
    np.testing.assert_allclose(seen[1][0], seen[0][0], atol=1e-6)
    np.testing.assert_allclose(seen[1][1], half_turn @ seen[0][1] @ half_turn, atol=1e-6)
    again = turned.turned(axis)
    assert all(np.array_equal(getattr(again, f), getattr(cloud, f)) for f in ("means", "quats", "rest"))


@pytest.mark.parametrize("name", format_names())
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_number_that_is_not_finite_is_refused_and_nothing_is_written(name: str, bad: float, tmp_path: Path) -> None:
    params = many(5)
    params["shN"][3, 2, 1] = bad
    with pytest.raises(PopError, match=r"shN\[3, 2, 1\] is (nan|inf)"):
        save_as(tmp_path / "x", name, params)
    assert not list(tmp_path.iterdir())


def test_a_centre_beyond_spz_is_refused() -> None:
    params = many(3)
    params["means"][1, 2] = 2.0**24
    with pytest.raises(PopError, match=r"a centre is 1.68e\+07 from the origin; SPZ holds up to 8388607"):
        encoded("spz", params)


@pytest.mark.parametrize("name", format_names())
def test_a_file_is_read_by_its_name_has_the_same_bytes_again_and_is_small(name: str, tmp_path: Path) -> None:
    path = tmp_path / ("x.ply" if name == "ply" else f"x{FORMATS[name].suffix}")
    size = save_as(path, name, many(9), True)
    params, antialiased, frame = load_splat_file(path)
    assert size == path.stat().st_size
    assert frame is None
    assert {key: value.shape for key, value in params.items()} == {key: value.shape for key, value in many(9).items()}
    assert antialiased == (name != "splat")
    data = encoded(name, many(3000))
    assert data == encoded(name, many(3000))
    # noise hardly compresses; compared with a PLY's 248 bytes it is small
    assert len(data) < 248 * 3000 / 4 or name not in ("spz", "spz-4", "sog", "gltf-spz")


@given(
    turn=arrays(np.float64, 3, elements=st.floats(-3.0, 3.0)),
    scale=st.floats(1e-3, 1e3),
    move=arrays(np.float64, 3, elements=st.floats(-1e4, 1e4)),
    kind=st.sampled_from(("capture", "training")),
)
@pytest.mark.parametrize("name", format_names())
def test_a_file_says_the_frame_to_the_last_bit(name, turn, scale, move, kind):
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = scale * Rotation.from_rotvec(turn).as_matrix(), move
    for frame in (Frame(kind), Frame(kind, tuple(map(tuple, transform.tolist())))):
        stored = from_bytes(name, encoded(name, many(3), True, frame))
        assert stored.frame == (None if name == "splat" else frame)
        assert loses_frame(name, frame) == (name == "splat" and kind == "training")
        # what is drawn is the same with it and without
        plain = from_bytes(name, encoded(name, many(3), True))
        assert all(torch.equal(value, plain.params[key]) for key, value in stored.params.items())


def test_a_compressed_ply_is_known_by_its_header_whatever_its_name(tmp_path: Path) -> None:
    save_as(tmp_path / "x.ply", "compressed-ply", many(9))
    assert len(load_splat_file(tmp_path / "x.ply")[0]["means"]) == 9
    save_ply(tmp_path / "y.compressed.ply", many(7))
    assert len(load_splat_file(tmp_path / "y.compressed.ply")[0]["means"]) == 7


@pytest.mark.parametrize(
    ("file", "to", "said"),
    [
        *(("a.SPZ", None, "spz"), ("a.glb", None, "gltf"), ("a.compressed.ply", None, "compressed-ply")),
        *(("a.glb", "gltf-spz", "gltf-spz"), ("a.spz", "spz-4", "spz-4"), ("a", "sog", "sog")),
        ("x.obj", None, "must end in one of .compressed.ply, .glb, .ply, .sog, .splat, .spz, or give --to"),
        ("x.ply", "spz", "ends in .ply, which is not how files of spz end; name it *.spz"),
        ("x.spz", "html5", "--to html5: no such format"),
        ("x.compressed.ply", "ply", "ends in .compressed.ply, which is not how files of ply end; name it *.ply"),
    ],
)
def test_the_name_says_the_format_and_must_agree_with_what_is_asked_for(file: str, to: str | None, said: str) -> None:
    if said in FORMATS:
        assert named_format(Path(file), to) == said
    else:
        assert_one_line(lambda: named_format(Path(file), to), said)


# Other programs' readers, and a description worked out by hand, on what we write.


def reader(name: str) -> ModuleType:
    """Import another program's reader, or skip with the reason."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        pytest.skip(f"{name} is not installed ({error}); pip install 'pop-splatting[formats-test]'")


GSPLY = {"compressed-ply": ("gsply", "plyread"), "sog": ("gsply.sog_reader", "sogread")}


@pytest.mark.parametrize("frame", [None, Frame("capture", tuple(map(tuple, np.eye(4).tolist())))])
@pytest.mark.parametrize("name", ["compressed-ply", "spz", "spz-4", "sog"])
@pytest.mark.parametrize("bands", [0, 3, 8, 15])
def test_gsply_reads_what_we_write(name: str, bands: int, frame: Frame | None, tmp_path: Path) -> None:
    module, function = GSPLY.get(name, ("gsply.spz", "read_spz"))
    if name == "sog":
        reader("imagecodecs")
    _, now, data = decoded(name, many(300, bands), frame=frame)
    path = tmp_path / f"x{FORMATS[name].suffix}"
    path.write_bytes(data)
    theirs = getattr(reader(module), function)(path)
    # it leaves SPZ in the frame of the file
    ours = now.turned("x") if name.startswith("spz") else now
    np.testing.assert_allclose(theirs.means, ours.means, atol=1e-5)
    np.testing.assert_allclose(theirs.scales, ours.log_scales, atol=1e-5)
    assert degrees(ours.quats, np.asarray(theirs.quats)).max() < 0.01
    np.testing.assert_allclose(theirs.sh0, ours.sh0, atol=1e-5)
    opacities = 1.0 / (1.0 + np.exp(-np.asarray(theirs.opacities, np.float64)))
    np.testing.assert_allclose(opacities, ours.opacities, atol=0.0011)
    if bands:
        np.testing.assert_allclose(np.asarray(theirs.shN).reshape(ours.rest.shape), ours.rest, atol=1e-5)


def assert_near(found: dict[str, torch.Tensor], want: dict[str, torch.Tensor], turn: float, **most: float) -> None:
    """Hold raw parameters to others: rotations within `turn` degrees, opacities after the sigmoid."""
    quats = torch.nn.functional.normalize(want["quats"], dim=1).numpy()
    assert degrees(quats, found["quats"].numpy()).max() < turn
    for name, atol in most.items():
        a, b = ((p[name].sigmoid() if name == "opacities" else p[name]) for p in (found, want))
        torch.testing.assert_close(a, b, atol=atol, rtol=0.0)


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("bands", [0, 3, 8, 15])
def test_we_read_the_spz_that_gsply_writes(version: int, bands: int, tmp_path: Path) -> None:
    module = reader("gsply.spz")
    _, now, data = decoded("spz", many(300, bands))
    (tmp_path / "ours.spz").write_bytes(data)
    theirs = module.read_spz(tmp_path / "ours.spz")
    module.write_spz(tmp_path / "theirs.spz", theirs, version=version, fractional_bits=16)
    most = {"means": 2.0**-17, "scales": 1e-5, "opacities": 0.004, "sh0": 0.03, "shN": 0.07}
    assert_near(load_splat_file(tmp_path / "theirs.spz").params, now.params(), 0.3, **most)


@pytest.mark.parametrize("bands", [0, 15])
def test_pygltflib_reads_our_attributes(bands: int, tmp_path: Path) -> None:
    pygltflib = reader("pygltflib")
    was, _, data = decoded("gltf", many(20, bands))
    (tmp_path / "x.glb").write_bytes(data)
    gltf = pygltflib.GLTF2().load(str(tmp_path / "x.glb"))
    primitive = gltf.meshes[0].primitives[0]
    assert primitive.mode == pygltflib.POINTS
    body = gltf.binary_blob()
    attributes = {key: value for key, value in vars(primitive.attributes).items() if value is not None}
    assert len(attributes) == 6 + bands
    turned = was.turned("z")

    def values(name: str) -> np.ndarray:
        accessor = gltf.accessors[attributes[name]]
        view = gltf.bufferViews[accessor.bufferView]
        part = body[view.byteOffset : view.byteOffset + view.byteLength]
        return np.frombuffer(part, "<f4").reshape(accessor.count, -1)

    np.testing.assert_array_equal(values("POSITION"), turned.means)
    np.testing.assert_allclose(values("KHR_gaussian_splatting:SCALE"), np.exp(turned.log_scales), rtol=1e-6)
    np.testing.assert_allclose(values("KHR_gaussian_splatting:OPACITY")[:, 0], was.opacities, atol=1e-7)
    np.testing.assert_array_equal(values("KHR_gaussian_splatting:ROTATION"), turned.quats[:, [1, 2, 3, 0]])
    if bands:
        np.testing.assert_array_equal(values("KHR_gaussian_splatting:SH_DEGREE_3_COEF_6"), turned.rest[:, 14])


def test_the_bytes_of_an_spz_file_are_those_of_its_description() -> None:
    """One Gaussian, computed by hand from the description."""
    params = {
        "means": torch.tensor([[1.0, -2.0, 0.5]]),
        "scales": torch.tensor([[-10.0, -2.0, 0.0]]),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "opacities": torch.tensor([0.0]),
        "sh0": torch.tensor([[[0.0, 1.0, -1.0]]]),
        "shN": torch.zeros(1, 0, 3),
    }
    raw, later = gzip.decompress(encoded("spz", params)), encoded("spz-4", params)
    bits = 20  # of the fraction: 2^20 times 2 fits into 23 bits
    centre = b"".join(struct.pack("<i", round(value * 2**bits))[:3] for value in (1.0, 2.0, -0.5))
    # y and z change their sign; 127.5 is rounded to the even 128; 38.25 a unit of colour; the largest component is w
    rest = bytes([128]) + bytes([128, 166, 89]) + bytes([0, 128, 160]) + struct.pack("<I", 3 << 30)
    assert raw == struct.pack("<IIIBBBB", 0x5053474E, 3, 1, 0, bits, 0, 0) + centre + rest
    # version 4: five streams, as there are no coefficients; the table follows the header of 32 bytes
    assert later[:32] == struct.pack("<IIIBBBBI12x", 0x5053474E, 4, 1, 0, bits, 0, 5, 32)
    sizes = struct.unpack("<10Q", later[32:112])
    assert sizes[1::2] == (9, 1, 3, 3, 4)
    ends = np.cumsum([112, *sizes[0::2]])
    columns = [later[a:b] for a, b in itertools.pairwise(ends.tolist())]
    assert b"".join(zstandard.decompress(column) for column in columns) == centre + rest
    assert ends[-1] == len(later)


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize(("number", "axis"), [(1, "y"), (4, "x"), (6, ""), (7, "z")])
def test_an_spz_file_that_says_its_coordinates_is_turned_from_there(version: int, number: int, axis: str) -> None:
    """Adobe's extension 0xADBE0003, and one of somebody else before it, which is skipped."""
    _, now, data = decoded("spz" if version == 3 else "spz-4", many(20))
    extensions = struct.pack("<II3s", 0x12340001, 3, b"abc") + struct.pack("<III", 0xADBE0003, 4, number)
    raw = bytearray(gzip.decompress(data) if version == 3 else data)
    raw[14] |= 2
    if version == 3:
        changed = gzip.compress(bytes(raw) + extensions)
    else:
        raw[16:20] = struct.pack("<I", 32 + len(extensions))
        changed = bytes(raw[:32]) + extensions + bytes(raw[32:])
    found = FORMATS["spz"].decode(changed, Path("x.spz"))
    # what is stored is what the default frame, half a turn about x away, makes of it
    stored = now.turned("x")
    np.testing.assert_array_equal(found.means, (stored.turned(axis) if axis else stored).means)


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("full", [0, 1, 2])
def test_ksplat_is_read_as_its_description_says(level: int, degree: int, full: int, tmp_path: Path) -> None:
    params = many(40, 8)
    params["means"] = params["means"].clamp(-1.0, 1.0)
    (tmp_path / "x.ksplat").write_bytes(ksplat_of(params, level, degree, full))
    stored = load_splat_file(tmp_path / "x.ksplat")
    assert stored.frame is None
    means, scales = (0.0, 1e-6) if level == 0 else (4e-5, 1e-3)
    assert_near(stored.params, params, 0.1, means=means, scales=scales, opacities=0.0021, sh0=0.008)
    bands, found = (0, 3, 8)[degree], stored.params["shN"]
    atol = (0.0, 1e-3, 0.008)[level]
    torch.testing.assert_close(found[:, :bands], params["shN"][:, :bands], atol=atol, rtol=0.0)
    assert not found[:, bands:].any()


def sog_folder(folder: Path, *more: Any) -> dict[str, Any]:
    """Unpack a SOG file of nine Gaussians and return its meta.json."""
    with zipfile.ZipFile(io.BytesIO(encoded("sog", many(9, *more)))) as archive:
        archive.extractall(folder)
    return json.loads((folder / "meta.json").read_text())


@pytest.mark.parametrize("bands", [0, 15])
def test_sog_in_a_folder_is_what_it_is_in_one_file(bands: int, tmp_path: Path) -> None:
    frame = Frame("training", tuple(map(tuple, (2.0 * np.eye(4)).tolist())))
    (tmp_path / "x.sog").write_bytes(encoded("sog", many(30, bands), True, frame))
    with zipfile.ZipFile(tmp_path / "x.sog") as archive:
        archive.extractall(tmp_path / "x")
    bundled, found = (load_splat_file(tmp_path / name) for name in ("x.sog", "x/meta.json"))
    assert (found.antialiased, found.frame) == (True, frame)
    for name, value in bundled.params.items():
        assert torch.equal(value, found.params[name])
    # the folder itself is a splat too
    assert torch.equal(load_splat(tmp_path / "x").params["means"], found.params["means"])


# Files that are damaged, cut off or of another version: named, and never read as something else.

# 2^28 bytes in a few thousand
BOMB = zstandard.compress(bytes(2**28))
Change = Callable[[dict[str, Any]], Any]


def spz(more: bytes = b"", **changes: int) -> bytes:
    """An SPZ file of one Gaussian in version 3, with a field of its header changed, or more behind its rows."""
    fields = {"magic": 0x5053474E, "version": 3, "n": 1, "degree": 0, "bits": 12, "flags": 0, "reserved": 0, **changes}
    return gzip.compress(struct.pack("<IIIBBBB", *fields.values()) + bytes(20) + more)


def spz_4(change: Change, end: int | None = None) -> bytes:
    """An SPZ file of version 4 with one Gaussian, with something of it changed, or cut off."""
    plain = [bytes(9), bytes(1), bytes(3), bytes(3), bytes(4)]
    parts: dict[str, Any] = {"n": 1, "degree": 0, "bits": 12, "flags": 0, "extensions": b"", "version": 4}
    parts["streams"] = [zstandard.compress(column, 3) for column in plain]
    change(parts)
    table = parts.get("table", 32 + len(parts["extensions"]))
    names = ("version", "n", "degree", "bits", "flags")
    count = parts.get("count", len(parts["streams"]))
    head = struct.pack("<IIIBBBBI12x", 0x5053474E, *(parts[name] for name in names), count, table)
    sizes = zip(parts["streams"], plain, strict=True)
    toc = b"".join(struct.pack("<QQ", len(stream), len(column)) for stream, column in sizes)
    return (head + parts["extensions"] + toc + b"".join(parts["streams"]))[:end]


def stream(number: int, data: bytes | None = None) -> Change:
    """Put another stream in its place, or cut it off."""
    return lambda parts: parts["streams"].__setitem__(number, data or parts["streams"][number][:-3])


def sog(change: Change, packed: int = zipfile.ZIP_STORED) -> bytes:
    """A SOG file of nine Gaussians with another meta.json."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(encoded("sog", many(9)))) as old, zipfile.ZipFile(buffer, "w", packed) as new:
        meta = json.loads(old.read("meta.json"))
        change(meta)
        for name in old.namelist():
            new.writestr(name, json.dumps(meta).encode() if name == "meta.json" else old.read(name))
    return buffer.getvalue()


def glb(change: Change) -> bytes:
    """A glTF file of five Gaussians with another JSON chunk."""
    whole = encoded("gltf", many(5))
    length = struct.unpack("<I", whole[12:16])[0]
    content = json.loads(whole[20 : 20 + length])
    change(content)
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + whole[20 + length :]
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def primitive(gltf: dict[str, Any]) -> dict[str, Any]:
    return gltf["meshes"][0]["primitives"][0]


DEFLATED = sog(id, zipfile.ZIP_DEFLATED)
DAMAGED: list[tuple[str, bytes, str]] = [
    ("spz", b"", "x: is cut off in its header"),
    ("spz", b"not gzip at all!", "x: its gzip stream is damaged"),
    ("spz", spz(magic=1), "x: begins with 0x1, not 0x5053474e"),
    ("spz", spz(version=9), "x: version is 9; write it as version 2, 3 or 4"),
    ("spz", spz(degree=4), "x: shDegree is 4"),
    ("spz", spz(bits=30), "x: fractionalBits is 30"),
    ("spz", spz(n=2), "x: ends after 20 of 40 bytes"),
    ("spz", spz(n=2**31), "x: numPoints is 2147483648, more than"),
    ("spz", spz(flags=128), "x: holds levels of detail"),
    ("spz", spz(struct.pack("<II", 7, 9), flags=2), "x: extension 0x7 of 9 bytes is cut off"),
    ("spz", spz(struct.pack("<IIB", 0xADBE0003, 1, 2), flags=2), "x: its coordinates are of kind 2"),
    ("spz", spz(struct.pack("<II3s", 0x504F0001, 3, b"{[}"), flags=2), "x: extension 0x504f0001 is damaged"),
    ("spz", spz(struct.pack("<II15s", 0x504F0001, 15, b'{"pop_frame":1}'), flags=2), "x: pop_frame is '1', which is"),
    ("spz-4", spz_4(lambda p: p.update(version=5)), "x: version is 5"),
    ("spz-4", spz_4(lambda p: p.update(n=2**31)), "x: numPoints is 2147483648, more than"),
    ("spz-4", spz_4(lambda p: p.update(n=2)), "x: stream 0 is to hold 9 bytes, not 18"),
    ("spz-4", spz_4(lambda p: p.update(n=0)), "x: numStreams is 5; its degree and count make 0"),
    ("spz-4", spz_4(lambda p: p.update(degree=1)), "x: numStreams is 5; its degree and count make 6"),
    ("spz-4", spz_4(lambda p: p.update(count=4)), "x: numStreams is 4"),
    ("spz-4", spz_4(lambda p: p.update(table=31)), "x: tocByteOffset is 31"),
    ("spz-4", spz_4(lambda p: p.update(table=2**31)), "x: tocByteOffset is 2147483648"),
    ("spz-4", spz_4(stream(2, b"no Zstandard")), "x: stream 2 is damaged"),
    ("spz-4", spz_4(stream(4)), "x: stream 4 (is damaged|holds other)"),
    ("spz-4", spz_4(stream(1, zstandard.compress(bytes(2)))), "x: stream 1 holds other than its 1 bytes"),
    # 2^28 bytes of zeros, of which one byte too many is made
    ("spz-4", spz_4(stream(3, BOMB)), "x: stream 3 holds other than its 3 bytes"),
    ("spz-4", spz_4(lambda p: p.update(flags=2, extensions=struct.pack("<II", 1, 2**31))), "x: extension 0x1 of"),
    *(("spz-4", spz_4(id, end), "x: (is cut off|tocByteOffset is 32)") for end in (20, 32, 100, -1)),
    ("sog", b"PK nothing", "x: is not a readable ZIP file"),
    ("sog", DEFLATED[:45] + bytes(20) + DEFLATED[65:], "x: meta.json in it is damaged"),
    ("sog", sog(lambda meta: meta.update(version=3)), "x: meta.json.version is 3"),
    ("sog", sog(lambda meta: meta.update(count=-1)), "x: meta.json.count is -1"),
    ("sog", sog(lambda meta: meta.update(count=10)), "x: "),
    ("sog", sog(lambda meta: meta.update(count=1000)), "x: means_l.webp is 3x3 pixels; 1000 are needed"),
    ("sog", sog(lambda meta: meta.pop("sh0")), "x: meta.json is not that of SOG version 2"),
    ("sog", sog(lambda meta: meta["scales"].update(codebook=[1.0])), "x: meta.json is not that of SOG version 2"),
    ("sog", sog(lambda meta: meta["quats"].update(files=["gone.webp"])), "x: meta.json is not that of SOG version 2"),
    ("sog", sog(lambda meta: meta["shN"].update(bands=4)), "x: meta.json.shN has 9 rows of 4 bands"),
    ("sog", sog(lambda meta: meta["shN"].update(count=3)), "x: shN_labels names row 8 of a palette of 3"),
    ("sog", sog(lambda meta: meta["means"].update(maxs=[1e30, 1, 1])), "x: means of Gaussian . is"),
    ("gltf", glb(lambda g: primitive(g)["extensions"].clear()), "holds no splat"),
    ("gltf", glb(lambda g: g["nodes"][0].update(translation=[1, 2, 3])), "a node moves its splat"),
    ("gltf", glb(lambda g: g["nodes"].append({"children": [0], "scale": [2, 2, 2]})), "a node moves its splat"),
    ("gltf", glb(lambda g: g["meshes"].append(g["meshes"][0])), "holds 2 splats; write each"),
    ("gltf", glb(lambda g: primitive(g)["extensions"].update({NAME: {"colorSpace": "lin"}})), "the colorSpace 'lin'"),
    ("gltf", glb(lambda g: primitive(g)["extensions"].update({NAME: {"kernel": "box"}})), "has the kernel 'box'; only"),
    ("gltf", glb(lambda g: primitive(g)["attributes"].pop("POSITION")), "no attribute POSITION"),
    ("gltf", glb(lambda g: g["accessors"][1].update(count=2**40)), "ROTATION is cut off"),
    ("gltf", glb(lambda g: g["accessors"][0].update(componentType=5123)), "POSITION is not stored as float32"),
    ("gltf", glb(lambda g: g["bufferViews"][0].update(byteLength=2**40)), "reaches beyond the binary chunk"),
    ("gltf", glb(lambda g: g["accessors"][0].update(count=4)), "attributes have different counts"),
    ("gltf", glb(lambda g: g.update(meshes=7)), "does not follow glTF 2.0"),
]


@pytest.mark.parametrize(("name", "data", "said"), DAMAGED, ids=range(len(DAMAGED)))
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_damaged_file_is_named_and_no_more_of_it_is_made_than_it_states(name: str, data: bytes, said: str) -> None:
    tracemalloc.start()
    with pytest.raises(PopError, match=said):
        FORMATS[name].decode(data, Path("x"))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert name != "spz-4" or peak < 2**22


def test_what_those_files_are_without_their_damage_is_read() -> None:
    # nodes without a transform in a circle, and extras of another program
    odd = glb(lambda g: g.update(asset={"extras": "mine"}, nodes=[{"mesh": 0, "children": [1]}, {"children": [0]}]))
    for name, data in (("spz", spz()), ("spz", spz(flags=2)), ("spz-4", spz_4(id)), ("gltf", glb(id)), ("gltf", odd)):
        assert len(FORMATS[name].decode(data, Path("x"))) == (5 if name == "gltf" else 1)


@pytest.mark.parametrize("n", [0, 30])
def test_an_spz_file_whose_end_is_cut_off_is_refused_wherever_that_is(n: int) -> None:
    whole = encoded("spz", many(n), frame=Frame("training"))
    assert FORMATS["spz"].decode(whole, Path("x")).frame == Frame("training")
    for end in range(len(whole)):
        with pytest.raises(PopError, match=r"x: .*(cut off|ends after)"):
            FORMATS["spz"].decode(whole[:end], Path("x"))


def test_version_4_without_its_package_is_refused_by_the_package_s_name(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = encoded("spz-4", many(5))
    monkeypatch.setitem(sys.modules, "zstandard", None)
    for use in (lambda: encoded("spz-4", many(5)), lambda: FORMATS["spz-4"].decode(whole, Path("x.spz"))):
        with pytest.raises(PopError, match="pip install zstandard"):
            use()


@pytest.mark.parametrize(
    ("at", "change", "said"),
    [
        (0, b"\1\0", "version is 1.0"),
        (1, b"\0", "version is 0.0"),
        (20, b"\3", "compressionLevel is 3"),
        (4, b"\xff\xff\xff\xff", "maxSectionCount is 4294967295, more than"),
        (4, b"\0\0\0\0", "splatCount is 12, and its sections hold other"),
        (16, b"\7", "splatCount is 7"),
        (4096, b"\3", "section 0: splatCount is 3, over maxSplatCount 2"),
        (4096 + 4, b"\xff\xff\xff\xff", "section 0: its rows end at byte"),
        (4096 + 12, b"\xff\xff\xff\xff", "section 0: its rows end at byte"),
        (4096 + 20, b"\x10", "section 0: bucketStorageSizeBytes is 16, not 12"),
        (4096 + 32, b"\xff\xff\xff\xff", "has 4294967295 full and 1 other buckets of 2"),
        (4096 + 36, b"\xff\xff\xff\xff", "section 0: its rows end at byte"),
        (4096 + 40, b"\4", "section 0: sphericalHarmonicsDegree is 4"),
        (4096 + 1024 + 16, b"\0\0\xc0\x7f", "means of Gaussian 2 is nan"),
        (4096 + 2 * 1024, b"\0\0\0\0", "its buckets hold 1 of 2 Gaussians"),
        (4096 + 2 * 1024 + 4 + 2 * 12 + 6, b"\0\xbc", "scale of Gaussian 0 is "),
    ],
)
def test_a_damaged_ksplat_is_named(at: int, change: bytes, said: str, tmp_path: Path) -> None:
    whole = ksplat_of(many(12, 8), 1)
    path = tmp_path / "x.ksplat"
    path.write_bytes(whole[:at] + change + whole[at + len(change) :])
    with pytest.raises(PopError, match=f"x.ksplat: {said}"):
        load_splat_file(path)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda folder, meta: (folder / "means_u.webp").unlink(), "means_u.webp: is absent, and meta.json names it"),
        (lambda folder, meta: (folder / "quats.webp").write_bytes(b"RIFF"), "meta.json: quats.webp is 0x0 pixels"),
        (lambda folder, meta: meta["sh0"].update(files=["../x.sog"]), "names the file '../x.sog', which is not"),
        (lambda folder, meta: meta["sh0"].update(files=["."]), "meta.json: names the file '.', which is not"),
        (lambda folder, meta: meta.pop("version"), "meta.json: meta.json.version is None; write it as version 2"),
        (lambda folder, meta: meta["asset"].update(pop_frame={"name": "x"}), "meta.json: pop_frame is "),
        (lambda folder, meta: meta.update(x="y" * 2**20), "meta.json: has 10"),
    ],
    ids=["absent", "no image", "elsewhere", "folder", "version 1", "frame", "long"],
)
def test_a_damaged_sog_in_a_folder_is_named(damage: Callable[[Path, Any], Any], said: str, tmp_path: Path) -> None:
    meta = sog_folder(tmp_path)
    damage(tmp_path, meta)
    (tmp_path / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(PopError, match=said):
        load_splat_file(tmp_path / "meta.json")


# A small file that asks for much memory is refused by what it states, before a byte of it is unpacked.

MB = 2**20


def sog_bomb(path: Path) -> None:
    """Write a splat of nothing, of whose pictures one is 256 MiB of zeros."""
    name = "means_l.webp"
    entry = {"codebook": [0.0] * 256, "files": [name]}
    means = {"mins": [0, 0, 0], "maxs": [0, 0, 0], "files": [name, name]}
    meta = {"version": 2, "count": 0, "means": means, "scales": entry, "quats": entry, "sh0": entry}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        archive.writestr("meta.json", json.dumps(meta))
        archive.writestr(name, bytes(256 * MB))


READ = """
import resource, sys
from pathlib import Path
import numpy as np, torch
from pop_fast.errors import PopError
from pop_fast.io.formats import load_splat_file
from pop_fast.io.images import read_image

for path in sys.argv[1:]:
    # the most memory so far: a later file that takes no more than an earlier one does not raise it
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        (read_image if path.endswith(".png") else load_splat_file)(Path(path))
    except PopError as error:
        print(error)
    print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, pop: Pop) -> None:
    n, bombs = 2_000_000, [tmp_path / f"a.{kind}" for kind in ("spz", "sog", "png")]
    bombs[0].write_bytes(spz(bytes(65 * n - 20), n=n, degree=3))
    sog_bomb(bombs[1])
    png_of_zeros(bombs[2], 8192, depth=16, kind=2)
    assert all(path.stat().st_size < MB for path in bombs)
    lines = in_a_child(READ, *bombs).out.splitlines()
    assert len(lines) == 2 * len(bombs)
    for path, line in zip(bombs, lines[::2], strict=True):
        assert line.startswith(f"{path}: ")
        assert re.search(r"would take [0-9,.]+ MB of memory to read, and the file has [0-9.]+ MB", line)
    assert sum(map(int, lines[1::2])) < 64, "MiB that all of them took over what importing took"
    told = pop("convert", tmp_path / "a.spz", tmp_path / "a.ply")
    says(told, "a.spz", "numPoints of 2000000", "too little for such content")


def test_a_count_of_gaussians_and_arrays_of_a_run_are_held_against_their_file(tmp_path: Path) -> None:
    meta = {"version": 2, "count": 10**8, "means": {"mins": [0, 0, 0], "maxs": [0, 0, 0], "files": []}}
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
        archive.writestr("meta.json", json.dumps(meta))
    with pytest.raises(PopError, match=r"a\.sog: meta\.json\.count of 100000000 would take"):
        load_splat_file(tmp_path / "a.sog")
    np.savez_compressed(tmp_path / "a.npz", counts=np.zeros(2**24, np.int64))
    with pytest.raises(PopError, match=r"a\.npz: 'counts\.npy' and what else is in it would take 134\.2 MB"):
        read_arrays(tmp_path / "a.npz", {"counts": ("i", 1)}, "train again")


def test_what_is_not_free_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.random.default_rng(0).integers(0, 256, (3000, 4200, 3), np.uint8)
    (tmp_path / "a.bmp").write_bytes(cv2.imencode(".bmp", image)[1].tobytes())
    assert read_image(tmp_path / "a.bmp").shape == image.shape
    film = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 5.0, (3072, 3072))
    for shade in (50, 200):
        film.write(np.full((3072, 3072, 3), shade, np.uint8))
    film.release()
    monkeypatch.setattr(read_back, "free_bytes", lambda: 50 * MB)
    end = "px would take .* and 52\\.4 MB are free"
    with pytest.raises(PopError, match=rf"a\.bmp: its header's size of 4200x3000 {end}"):
        read_image(tmp_path / "a.bmp")
    with pytest.raises(PopError, match=rf"a\.avi: its frames of 3072x3072 {end}; convert"):
        take_frames(tmp_path / "a.avi", tmp_path / "out", 3)
    monkeypatch.setattr(read_back, "free_bytes", lambda: 0)
    # a small need is never questioned
    check_memory("a", 2**26, 1, "x", "y")
    with pytest.raises(PopError, match=r"^a: x would take .* and 0\.0 MB are free; y$"):
        check_memory("a", 2**26 + 1, 2**30, "x", "y")


def test_a_limit_of_this_process_counts() -> None:
    script = """
import resource
from pathlib import Path
from pop_fast.machine import free_bytes

have = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (have + 2**28, have + 2**28))
print(free_bytes())
"""
    outcome = in_a_child(script)
    assert 2**27 < int(outcome.out) <= 2**28, outcome.err[-500:]


def test_pictures_of_one_colour_are_no_bombs(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((6000, 6000), 255, np.uint8))
    assert (tmp_path / "mask.png").stat().st_size < 2 * 36_000_000 / 200
    assert read_image(tmp_path / "mask.png").shape == (6000, 6000, 3)
