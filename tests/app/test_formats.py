"""File formats of splats: what a round trip loses, what other programs' readers see, and what is refused."""

from __future__ import annotations

import gzip
import importlib
import itertools
import struct
import zipfile
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
import zstandard
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation
from torch import Tensor

from benchmarks.faults.ksplat import ksplat_of
from pop_fast.errors import PopError
from pop_fast.io.formats import FORMATS, encoded, format_names, load_splat_file, loses_frame, named_format, save_as
from pop_fast.io.formats import decoded as from_bytes
from pop_fast.io.formats.cloud import SH_C0, Cloud, morton_order
from pop_fast.io.formats.compressed_ply import chunked
from pop_fast.io.formats.sog import codebook, nearest, row_palette
from pop_fast.io.ply import Frame, load_ply, save_ply
from pop_fast.train.load_result import load_splat
from pop_ref.covariance import covars_from_quats_scales
from pop_ref.harmonics import sh_basis
from tests.app.clouds import decoded, degrees, many, splats

BYTE = 0.5 / 255.0
# of degree 0, in coefficients
COLOR_BYTE = BYTE / SH_C0


def assert_within(was: np.ndarray, now: np.ndarray, bound: Any, what: str) -> None:
    excess = np.abs(was.astype(np.float64) - now) - bound
    assert not len(excess) or excess.max() <= 1e-6 * (1.0 + np.abs(was).max(initial=0.0)), what


def chunk_extent(values: np.ndarray) -> np.ndarray:
    """The extent of every row's chunk of 256 rows."""
    if not len(values):
        return values
    chunks = [values[i : i + 256] for i in range(0, len(values), 256)]
    return np.concatenate([np.broadcast_to(np.ptp(chunk, axis=0), chunk.shape) for chunk in chunks])


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
        return {
            "means": half * chunk_extent(was.means),
            "log_scales": half * chunk_extent(was.log_scales),
            "degrees": 0.28,
            "opacities": BYTE,
            "sh0": BYTE * chunk_extent(was.sh0),
            "rest": 1 / 64,
        }
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
            value = (
                np.clip(was.sh0, -0.5 / SH_C0, 0.5 / SH_C0)
                if (name, field) == ("splat", "sh0")
                else getattr(was, field)
            )
            assert_within(value, getattr(now, field), bounds[field], field)
    assert not len(was) or degrees(was.quats, now.quats).max() <= bounds["degrees"]
    assert now.degree == (0 if name == "splat" else was.degree)
    assert now.antialiased == (antialiased and name != "splat")
    assert np.isfinite(now.logits).all()


@pytest.mark.parametrize("name", FORMATS)
@given(params=splats())
def test_what_came_out_of_a_file_goes_in_and_out_again_almost_unchanged(name: str, params: dict) -> None:
    _, first, _ = decoded(name, params)
    was, again, _ = decoded(name, first.params())
    np.testing.assert_allclose(was.opacities, again.opacities, atol=1.01 * BYTE)
    assert not len(was) or degrees(was.quats, again.quats).max() <= (14.0 if name == "gltf-spz" else 1.2)
    np.testing.assert_allclose(was.means, again.means, atol=0.1)


def test_rotations_away_from_half_turns_lose_less_in_the_draft_of_gltf() -> None:
    was, now, _ = decoded("gltf-spz", many(4000))
    upright = np.abs(was.quats[:, 0]) > 0.3
    assert upright.sum() > 1000
    assert degrees(was.quats, now.quats)[upright].max() < 2.6


def test_a_palette_is_near_what_it_stands_for() -> None:
    was, now, _ = decoded("sog", many(2000))
    for field, most in (("log_scales", 0.015), ("sh0", 0.005)):
        # a colour under an opacity of 0 is lost
        errors = (getattr(was, field) - getattr(now, field))[was.opacities > 1.0 / 255.0]
        assert np.sqrt((errors**2).mean()) < most
    # 500 rows for 2,000 rows of noise cannot explain much; they must explain a share, and real colours are no noise
    explained = 1.0 - ((was.rest - now.rest) ** 2).mean() / was.rest.var()
    assert explained > 0.2


def test_few_distinct_colours_are_kept_by_a_palette() -> None:
    params = many(2000)
    params["shN"] = many(40)["shN"].repeat(50, 1, 1)
    was, now, _ = decoded("sog", params)
    # each is a row of the palette, whose numbers are rounded to the nearest of 256, few of which are far out
    assert np.sqrt(((was.rest - now.rest) ** 2).mean()) < 0.005
    assert np.abs(was.rest - now.rest).max() < 0.03


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
    error = {}
    for name, given_weights in (("even", None), ("weighted", weights)):
        codes = codebook(numbers, given_weights)
        error[name] = float((weights * (codes[nearest(codes, numbers)] - numbers) ** 2).sum())
    assert error["weighted"] < 0.5 * error["even"]


def test_a_centre_is_rounded_beside_what_its_gaussian_measures() -> None:
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


def test_a_palette_gives_every_row_its_nearest_within_its_group() -> None:
    rows = many(600)["shN"].reshape(600, -1).numpy()
    palette, labels = row_palette(rows, np.ones(600), 64)
    assert len(palette) <= 64
    assert labels.max() < len(palette)
    assert ((rows - palette[labels]) ** 2).sum() < ((rows - rows.mean(0)) ** 2).sum()


def test_the_space_filling_curve_is_a_permutation_that_keeps_neighbours_close() -> None:
    means = many(4096)["means"].numpy()
    order = morton_order(means)
    assert np.array_equal(np.sort(order), np.arange(4096))
    assert (
        np.linalg.norm(np.diff(means[order], axis=0), axis=1).mean()
        < 0.3 * np.linalg.norm(np.diff(means, axis=0), axis=1).mean()
    )


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
    sh, sh_turned = (np.concatenate([c.sh0[:, None], c.rest], axis=1).astype(np.float64) for c in (cloud, turned))
    was, now = (
        np.einsum("nk,nkc->nc", sh_basis(along, 3), values)
        for along, values in ((directions, sh), (directions @ half_turn, sh_turned))
    )
    np.testing.assert_allclose(now, was, atol=1e-6)
    scales = np.exp(cloud.log_scales.astype(np.float64))
    was = covars_from_quats_scales(cloud.quats.astype(np.float64), scales)
    np.testing.assert_allclose(
        covars_from_quats_scales(turned.quats.astype(np.float64), scales), half_turn @ was @ half_turn, atol=1e-6
    )
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
def test_the_same_splat_gives_the_same_bytes(name: str) -> None:
    assert encoded(name, many(300)) == encoded(name, many(300))


@pytest.mark.parametrize("name", ["spz", "spz-4", "sog", "gltf-spz"])
def test_a_small_format_is_small(name: str) -> None:
    # noise hardly compresses; compared with a PLY's 248 bytes it is small
    assert len(encoded(name, many(3000))) < 248 * 3000 / 4


@pytest.mark.parametrize("name", format_names())
def test_a_file_is_read_by_its_name(name: str, tmp_path: Path) -> None:
    path = tmp_path / ("x.ply" if name == "ply" else f"x{FORMATS[name].suffix}")
    size = save_as(path, name, many(9), True)
    params, antialiased, frame = load_splat_file(path)
    assert size == path.stat().st_size
    assert frame is None
    assert {key: tuple(value.shape) for key, value in params.items()} == {
        key: tuple(value.shape) for key, value in load_reference(tmp_path).items()
    }
    assert antialiased == (name != "splat")


@given(
    turn=arrays(np.float64, 3, elements=st.floats(-3.0, 3.0)),
    scale=st.floats(1e-3, 1e3),
    move=arrays(np.float64, 3, elements=st.floats(-1e4, 1e4)),
    kind=st.sampled_from(("capture", "training")),
)
@pytest.mark.parametrize("name", format_names())
def test_a_file_says_the_frame_to_the_last_bit(
    name: str, turn: np.ndarray, scale: float, move: np.ndarray, kind: Any
) -> None:
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = scale * Rotation.from_rotvec(turn).as_matrix(), move
    for frame in (Frame(kind), Frame(kind, tuple(map(tuple, transform.tolist())))):
        stored = from_bytes(name, encoded(name, many(3), True, frame))
        assert stored.frame == (None if name == "splat" else frame)
        assert loses_frame(name, frame) == (name == "splat" and kind == "training")
        # what is drawn is the same with it and without
        plain = from_bytes(name, encoded(name, many(3), True))
        assert all(torch.equal(value, plain.params[key]) for key, value in stored.params.items())


def load_reference(tmp_path: Path) -> dict[str, Tensor]:
    save_ply(tmp_path / "reference.ply", many(9))
    return load_ply(tmp_path / "reference.ply")


def test_a_compressed_ply_is_known_by_its_header_whatever_its_name(tmp_path: Path) -> None:
    save_as(tmp_path / "x.ply", "compressed-ply", many(9))
    assert len(load_splat_file(tmp_path / "x.ply")[0]["means"]) == 9
    save_ply(tmp_path / "y.compressed.ply", many(7))
    assert len(load_splat_file(tmp_path / "y.compressed.ply")[0]["means"]) == 7


@pytest.mark.parametrize(
    ("file", "to", "said"),
    [
        ("x.obj", None, "must end in one of .compressed.ply, .glb, .ply, .sog, .splat, .spz, or give --to"),
        ("x.ply", "spz", "ends in .ply, which is not how files of spz end; name it [*].spz"),
        ("x.spz", "html5", "--to html5: no such format"),
        ("x.compressed.ply", "ply", "ends in .compressed.ply, which is not how files of ply end; name it [*].ply"),
    ],
)
def test_a_name_and_a_format_must_agree(file: str, to: str | None, said: str) -> None:
    with pytest.raises(PopError, match=said):
        named_format(Path(file), to)


def test_the_name_says_the_format() -> None:
    assert named_format(Path("a.SPZ")) == "spz"
    assert named_format(Path("a.glb")) == "gltf"
    assert named_format(Path("a.glb"), "gltf-spz") == "gltf-spz"
    assert named_format(Path("a.spz"), "spz-4") == "spz-4"
    assert named_format(Path("a.compressed.ply")) == "compressed-ply"
    assert named_format(Path("a"), "sog") == "sog"


# Other programs' readers, and a description worked out by hand, on what we write.


def reader(name: str) -> ModuleType:
    """Import another program's reader, or skip with the reason."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        pytest.skip(f"{name} is not installed ({error}); pip install 'pop-splatting[formats-test]'")


@pytest.mark.parametrize("frame", [None, Frame("capture", tuple(map(tuple, np.eye(4).tolist())))])
@pytest.mark.parametrize("name", ["compressed-ply", "spz", "spz-4", "sog"])
@pytest.mark.parametrize("bands", [0, 3, 8, 15])
def test_gsply_reads_what_we_write(name: str, bands: int, frame: Frame | None, tmp_path: Path) -> None:
    modules = {"compressed-ply": "gsply", "spz": "gsply.spz", "spz-4": "gsply.spz", "sog": "gsply.sog_reader"}
    module = reader(modules[name])
    if name == "sog":
        reader("imagecodecs")
    _, now, data = decoded(name, many(300, bands), frame=frame)
    path = tmp_path / f"x{FORMATS[name].suffix}"
    path.write_bytes(data)
    found = {"compressed-ply": "plyread", "spz": "read_spz", "spz-4": "read_spz", "sog": "sogread"}[name]
    theirs = getattr(module, found)(path)
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


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("bands", [0, 3, 8, 15])
def test_we_read_the_spz_that_gsply_writes(version: int, bands: int, tmp_path: Path) -> None:
    module = reader("gsply.spz")
    _, now, data = decoded("spz", many(300, bands))
    (tmp_path / "ours.spz").write_bytes(data)
    theirs = module.read_spz(tmp_path / "ours.spz")
    module.write_spz(tmp_path / "theirs.spz", theirs, version=version, fractional_bits=16)
    again = load_splat_file(tmp_path / "theirs.spz").params
    ours = now.params()
    torch.testing.assert_close(again["means"], ours["means"], atol=2.0**-17, rtol=0.0)
    torch.testing.assert_close(again["scales"], ours["scales"], atol=1e-5, rtol=0.0)
    assert degrees(ours["quats"].numpy(), again["quats"].numpy()).max() < 0.3
    torch.testing.assert_close(again["opacities"].sigmoid(), ours["opacities"].sigmoid(), atol=0.004, rtol=0.0)
    torch.testing.assert_close(again["sh0"], ours["sh0"], atol=0.03, rtol=0.0)
    torch.testing.assert_close(again["shN"], ours["shN"], atol=0.07, rtol=0.0)


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
    streams = [later[a:b] for a, b in itertools.pairwise(ends.tolist())]
    assert b"".join(zstandard.decompress(stream) for stream in streams) == centre + rest
    assert ends[-1] == len(later)


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize(("number", "axis"), [(1, "y"), (4, "x"), (6, ""), (7, "z")])
def test_an_spz_file_that_says_its_coordinates_is_turned_from_there(version: int, number: int, axis: str) -> None:
    """Adobe's extension 0xADBE0003, and one of somebody else before it, which is skipped."""
    _, now, data = decoded("spz" if version == 3 else "spz-4", many(20))
    extensions = struct.pack("<II3s", 0x12340001, 3, b"abc") + struct.pack("<III", 0xADBE0003, 4, number)
    if version == 3:
        raw = bytearray(gzip.decompress(data))
        raw[14] |= 2
        changed = gzip.compress(bytes(raw) + extensions)
    else:
        head = bytearray(data[:32])
        head[14] |= 2
        head[16:20] = struct.pack("<I", 32 + len(extensions))
        changed = bytes(head) + extensions + data[32:]
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
    found, was = stored.params, params
    exact = level == 0
    torch.testing.assert_close(found["means"], was["means"], atol=0.0 if exact else 4e-5, rtol=0.0)
    torch.testing.assert_close(found["scales"], was["scales"], atol=1e-6 if exact else 1e-3, rtol=0.0)
    assert degrees(torch.nn.functional.normalize(was["quats"], dim=1).numpy(), found["quats"].numpy()).max() < 0.1
    torch.testing.assert_close(found["opacities"].sigmoid(), was["opacities"].sigmoid(), atol=0.0021, rtol=0.0)
    torch.testing.assert_close(found["sh0"], was["sh0"], atol=0.008, rtol=0.0)
    bands = (0, 3, 8)[degree]
    atol = (0.0, 1e-3, 0.008)[level]
    torch.testing.assert_close(found["shN"][:, :bands], was["shN"][:, :bands], atol=atol, rtol=0.0)
    assert not found["shN"][:, bands:].any()


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
