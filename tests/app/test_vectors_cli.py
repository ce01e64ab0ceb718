"""`pop vectors`: what it writes is enough for a port without Python, and what it is given is answered in one line."""

from __future__ import annotations

import functools
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pop_fast.cli import main
from tests.app.conftest import Pop
from tests.app.damage import contents, says, truncate


@pytest.fixture(scope="session")
def shared_vectors(made_once: Callable[..., Path]) -> Path:

    def make(folder: Path) -> None:
        assert main(["vectors", "export", str(folder / "vectors")]) == 0

    return made_once("vectors", make) / "vectors"


@pytest.fixture
def vectors(shared_vectors: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(shared_vectors, tmp_path / "vectors"))


@pytest.fixture(scope="session")
def port(shared_vectors: Path, made_once: Callable[..., Path]) -> Path:
    """The results of a sound port, which tests only read."""

    def make(folder: Path) -> None:
        # by its own judgement, from the index alone, nothing fails
        assert run(shared_vectors, folder / "results") == set()

    return made_once("port", make) / "results"


@pytest.mark.slow
def test_a_port_written_from_the_index_passes_in_npz_and_in_json(pop, shared_vectors, port, tmp_path):
    outcome = pop("vectors", "check", shared_vectors, port)
    drawn = len(list(port.iterdir()))
    assert outcome.status == 0, outcome.out
    assert drawn >= 10
    assert f"image         {drawn} of {drawn} vectors pass" in outcome.out
    assert "not there, not judged: depths, means2d, conics" in outcome.out
    assert "no result for, not judged: harmonics_of_degree_three, inria" in outcome.out
    assert outcome.out.endswith("all arrays that are there pass\n")
    for path in port.iterdir():
        with np.load(path) as stored:
            text = json.dumps({name: stored[name].tolist() for name in stored.files})
        (tmp_path / f"{path.stem}.json").write_text(text)
    pop.done("vectors", "check", shared_vectors, tmp_path)


def test_a_broken_port_is_told_which_array_of_which_vector_and_where(pop, shared_vectors, tmp_path):
    own = run(shared_vectors, tmp_path / "results", shift=0.0, most=100)
    assert ("one_round_splat", "image") in own
    outcome = pop("vectors", "check", shared_vectors, tmp_path / "results")
    assert outcome.status == 1
    blocks = dict(zip(*[iter(_split(outcome.out))] * 2, strict=True))
    found = {(line.split(":")[0].strip(), array) for array, lines in blocks.items() for line in lines}
    # the command and the port's own few lines agree on every array
    assert {pair for pair in found if pair[1] in ("image", "T_final", "dominant_ids", "n_blended")} == own
    assert "one_round_splat: off by" in outcome.out
    assert "at [" in outcome.out
    assert f"{len(own)} of {4 * len(list((tmp_path / 'results').iterdir()))} arrays fail" in outcome.out


def _split(text: str) -> list:
    """Give array names and the indented lines under each, in turns."""
    parts: list = []
    for line in text.splitlines():
        if line.startswith("  "):
            parts[-1].append(line)
        elif "vectors pass" in line:
            parts += [line.split()[0], []]
    return parts


def test_one_wrong_entry_is_found_and_what_the_index_does_not_know_is_said(pop, shared_vectors, port, tmp_path):
    results = shutil.copytree(port, tmp_path / "results")
    (results / "notes.txt").write_text("mine")
    (results / "golden.json").write_text("{}")
    with np.load(results / "golden.npz") as stored:
        arrays = {**stored, "v_mean": np.zeros(3)}
    np.savez(results / "golden.npz", **arrays)
    outcome = pop.done("vectors", "check", shared_vectors, results)
    assert "unknown, not judged: notes.txt, golden.json (golden.npz is there), golden.npz: v_mean" in outcome.out
    arrays["image"][3, 5, 1] += 1e-3
    np.savez(results / "golden.npz", **arrays)
    outcome = pop("vectors", "check", shared_vectors, results)
    assert outcome.status == 1
    (line,) = (line for line in outcome.out.splitlines() if "golden: off by" in line)
    assert re.search(r"off by \S+ of its error_bound, allowed \S+; ", line), line
    assert "at [3, 5, 1]: got " in outcome.out
    # what is not finite never passes
    np.savez(results / "golden.npz", T_final=np.full_like(arrays["T_final"], np.nan))
    outcome = pop("vectors", "check", shared_vectors, results)
    assert outcome.status == 1
    assert "golden: off by inf" in outcome.out


@pytest.mark.slow  # it makes every vector
def test_an_export_says_what_it_wrote_and_leaves_an_existing_folder_alone(pop, vectors, shared_vectors, monkeypatch):
    (vectors / "mine.txt").write_text("keep")
    before = contents(vectors)
    says(pop("vectors", "export", vectors), str(vectors), "--overwrite")
    assert contents(vectors) == before
    with monkeypatch.context() as patch:
        # what it wrote is known when all is written, which takes seconds: here it is what was written before
        copied = functools.partial(shutil.copytree, shared_vectors, dirs_exist_ok=True)
        patch.setattr("pop_ref.conformance.vectors.export", copied)
        says(pop("vectors", "export", vectors, "--overwrite"), str(vectors), "did not write (mine.txt)")
    assert contents(vectors) == before
    (vectors / "mine.txt").unlink()
    outcome = pop("vectors", "export", vectors, "--overwrite")
    assert outcome.out.startswith(f"316 vectors -> {vectors}; {vectors / 'index.json'}")
    # zip archives carry times; what is in them is the same on every run
    for name in before:
        if name.suffix == ".npz":
            continue
        assert name.name == "mine.txt" or name.read_bytes() == before[name]


def test_an_export_that_fails_leaves_nothing(pop: Pop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wrote = []

    def full(path: Path, **arrays: object) -> None:
        wrote.append(path)
        Path(path).write_bytes(b"half")
        if len(wrote) == 3:
            raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(np, "savez_compressed", full)
    says(pop("vectors", "export", tmp_path / "new"), "disk is full")
    assert len(wrote) == 3
    assert list(tmp_path.iterdir()) == []


def _index(change: Callable[[dict], object]) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        index = json.loads((folder / "index.json").read_text())
        change(index)
        (folder / "index.json").write_text(json.dumps(index))

    return damage


def _without(name: str) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        with np.load(folder / "golden.npz") as stored:
            np.savez(folder / "golden.npz", **{key: stored[key] for key in stored.files if key != name})

    return damage


@pytest.mark.parametrize(
    ("damage", "parts"),
    [
        (shutil.rmtree, ("no such folder", "pop vectors export")),
        (lambda f: (f / "index.json").unlink(), ("index.json", "absent", "pop vectors export")),
        (lambda f: truncate(f / "index.json"), ("index.json", "damaged", "pop vectors export")),
        (lambda f: (f / "index.json").write_text("[]"), ("index.json", "format")),
        (_index(lambda i: i.update(format="other")), ("index.json", "format is not 'pop-vectors'")),
        (_index(lambda i: i.update(version=1)), ("index.json", "version is 1", "reads 4", "again")),
        (_index(lambda i: i.pop("kinds")), ("index.json", "kinds is absent")),
        (lambda f: (f / "golden.npz").unlink(), ("golden.npz", "absent", "again")),
        (lambda f: truncate(f / "golden.npz"), ("golden.npz", "is no npz file", "again")),
        (lambda f: (f / "golden.npz").write_text("hello"), ("golden.npz", "is no npz file")),
        (lambda f: np.savez(f / "golden.npz", other=np.zeros(3)), ("golden.npz", "has no array means", "again")),
        (_without("error_bound_image"), ("golden.npz", "has no array error_bound_image")),
        (_index(lambda i: i["vectors"]["golden"]["shapes"].update(image=[1])), ("golden.npz", "image has shape")),
    ],
    ids=lambda value: None if callable(value) else value[-1],
)
def test_damaged_vectors_are_refused_by_one_line(pop, vectors, port, damage, parts):
    damage(vectors)
    says(pop("vectors", "check", vectors, port), *parts)


def _result(**arrays: object) -> Callable[[Path], None]:
    return lambda folder: np.savez(folder / "golden.npz", **arrays)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("damage", "parts"),
    [
        (shutil.rmtree, ("no such folder", "NAME.npz")),
        (lambda f: None, ("holds nothing to judge", "one_round_splat.npz", "image")),
        (_result(other=np.zeros(3)), ("holds nothing to judge",)),
        (_result(image=np.zeros((2, 2, 3))), ("golden.npz", "image has shape [2, 2, 3]", "must be [16, 16, 3]")),
        (_result(image=np.full((16, 16, 3), "a")), ("golden.npz", "image has type", "numbers")),
        (_result(image=np.array([None])), ("golden.npz", "is no npz file")),
        (lambda f: (f / "golden.npz").write_bytes(b""), ("golden.npz", "is no npz file")),
        (lambda f: (f / "golden.json").write_text("{"), ("golden.json", "is no JSON")),
        (lambda f: (f / "golden.json").write_text("[1]"), ("golden.json", "is no JSON")),
        (lambda f: (f / "golden.json").write_text('{"image": [[1], [1, 2]]}'), ("golden.json", "is no JSON")),
    ],
    ids=["no folder", "empty", "foreign", "shape", "type", "objects", "no bytes", "no json", "no object", "ragged"],
)
def test_results_that_cannot_be_read_are_refused_by_one_line(pop, shared_vectors, tmp_path, damage, parts):
    results = tmp_path / "results"
    results.mkdir()
    damage(results)
    says(pop("vectors", "check", shared_vectors, results), *parts)


@pytest.mark.parametrize("words", [(), ("judge",), ("check", "a"), ("check", "a", "b", "--dtype", "half")])
def test_bad_usage_has_status_two(pop: Pop, words: tuple[str, ...]) -> None:
    assert pop("vectors", *words).status == 2


# A renderer as somebody would port it: written from what `index.json` says, with json and numpy alone, in float32. It
# draws what it can (no square extents, harmonics to degree 1, no gradients) and judges itself by the index.

Real = np.float32
Arrays = dict[str, np.ndarray]


def rotation(quat: np.ndarray) -> np.ndarray:
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def splat(a: Arrays, i: int, options: dict) -> tuple | None:
    """Project Gaussian i: (depth, centre, inverse covariance, opacity, colour), None behind the near plane."""
    profile, K = options["profile"], a["K"]
    R, t = a["viewmat"][:3, :3], a["viewmat"][:3, 3]
    x, y, z = p = R @ a["means"][i] + t
    if z < profile["near_plane"]:
        return None
    slopes = []
    for axis, size in ((0, options["width"]), (1, options["height"])):
        f, c, margin = K[axis, axis], K[axis, 2], profile["frustum_margin"] * size / 2
        slopes.append(np.clip(p[axis] / z, (-c - margin) / f, (size - c + margin) / f))
    J = np.array([[K[0, 0], 0, -K[0, 0] * slopes[0]], [0, K[1, 1], -K[1, 1] * slopes[1]]], Real) / z
    half = J @ R @ rotation(a["quats"][i]) * a["scales"][i]
    raw = half @ half.T
    blurred = raw + Real(profile["eps2d"]) * np.eye(2, dtype=Real)
    opacity = a["opacities"][i]
    if options["antialiased"]:
        opacity = opacity * np.sqrt(max(Real(0), np.linalg.det(raw) / np.linalg.det(blurred)))
    direction = a["means"][i] + R.T @ t
    dx, dy, dz = direction / np.linalg.norm(direction)
    basis = 0.4886025119029199 * np.array([-dy, dz, -dx])
    basis = np.array([0.28209479177387814, *basis], Real)[: (options["sh_degree"] + 1) ** 2]
    color = np.maximum(0, Real(0.5) + basis @ a["sh"][i, : len(basis)])
    center = np.array([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]])
    return z, center, np.linalg.inv(blurred), opacity, color, i


def draw(a: Arrays, options: dict, shift: float = 0.5) -> Arrays:
    """Render a vector; `shift` is where in a pixel its centre lies."""
    a = {name: value.astype(Real) if value.dtype == np.float64 else value for name, value in a.items()}
    profile, shape = options["profile"], (options["height"], options["width"])
    splats = [s for i in range(len(a["means"])) if (s := splat(a, i, options)) is not None]
    splats.sort(key=lambda s: (s[0], s[5]))
    image, left = np.zeros((*shape, 3), Real), np.ones(shape, Real)
    ids, counts = np.full(shape, -1), np.zeros(shape, np.int64)
    for y, x in np.ndindex(shape):
        T, best = Real(1), Real(0)
        for _, center, conic, opacity, color, i in splats:
            d = center - np.array([x + shift, y + shift], Real)
            sigma = d @ conic @ d / 2
            alpha = min(Real(profile["alpha_ceiling"]), opacity * np.exp(-sigma))
            if sigma < 0 or alpha < profile["alpha_floor"]:
                continue
            rest = T * (1 - alpha)
            if rest < profile["transmittance_stop"] or (
                profile["stop_inclusive"] and rest == profile["transmittance_stop"]
            ):
                break
            image[y, x] += T * alpha * color
            if T * alpha > best:
                best, ids[y, x] = T * alpha, i
            T, counts[y, x] = rest, counts[y, x] + 1
        image[y, x] += T * a["background"]
        left[y, x] = T
    return {"image": image, "T_final": left, "dominant_ids": ids, "n_blended": counts}


def within_reach(vector: dict) -> bool:
    options = vector["options"]
    return vector["kind"] == "render" and options["profile"]["extent"] == "opacity_aware" and options["sh_degree"] <= 1


def judge(index: dict, wanted: Arrays, name: str, result: np.ndarray) -> bool:
    """Compare one output as the index says."""
    (rule,) = index["kinds"]["render"]["arrays"][name]["compare"]
    mask = wanted[rule["where"]] if rule["where"] else np.array(True)
    mask = mask.reshape(mask.shape + (1,) * (result.ndim - mask.ndim))
    if rule["rule"] == "equal":
        good = result == wanted[name]
    else:
        limit = rule["limit"]["float32"] * wanted[rule["error_bound"]] + index["tiny"]["float32"]
        good = np.abs(result - wanted[name]) <= limit
    return bool(np.all(good | ~mask))


def run(vectors: Path, results: Path, shift: float = 0.5, most: int = 10**9) -> set[tuple[str, str]]:
    """Draw every vector within reach, write the results, and return which arrays of which vectors fail.

    Args:
        most: vectors of more Gaussians are left out.
    """
    index = json.loads((vectors / "index.json").read_text())
    results.mkdir()
    failed = set()
    for name, vector in index["vectors"].items():
        if not within_reach(vector):
            continue
        with np.load(vectors / vector["file"]) as stored:
            wanted = {key: stored[key] for key in stored.files}
        if len(wanted["means"]) > most:
            continue
        arrays = index["kinds"]["render"]["arrays"]
        inputs = {key: value for key, value in wanted.items() if arrays[key]["role"] == "input"}
        drawn = draw(inputs, vector["options"], shift)
        np.savez(results / f"{name}.npz", **drawn)  # type: ignore[arg-type]
        failed |= {(name, key) for key, value in drawn.items() if not judge(index, wanted, key, value)}
    return failed
