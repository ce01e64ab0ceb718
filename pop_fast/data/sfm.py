"""Structure from motion: find the cameras of a bare folder of photographs with pycolmap, on the CPU.

SIFT features, exhaustive matching of up to 60 photographs (beyond that every photograph with its neighbours by name),
incremental mapping. Every random choice is seeded and the largest model is kept. Where that places too few of up to 40
photographs, they are searched again with features that are recognised from further aside.

Cameras are found for the pixels as they are stored, as COLMAP does. Which photographs a viewer would turn by their EXIF
orientation is written next to the model (`sparse/upright.json`), and `load_capture` turns these and their cameras.

The search runs in a process of its own. COLMAP computes for minutes inside one call, where no signal is heard. A
process can be ended at any moment, and takes COLMAP's threads, its log and its memory with it. The words of the two
processes are lines of JSON: one job, and for it any number of reports of progress and one end. Nobody else opens
COLMAP's database meanwhile: COLMAP does not wait for a lock, and a reader made its searches fail.

It leaves a list of its files, so that replacing a result removes nothing else. The list lies next to the model as
`sparse/sfm.sha256`, in the format of `sha256sum`, with paths relative to the capture.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

from pop_fast.children import python_command
from pop_fast.data.cameras import require_colmap
from pop_fast.data.capture import Progress, SfmOptions
from pop_fast.data.colmap import quiet_colmap, read_binary
from pop_fast.data.exports import photographs_of_polycam
from pop_fast.data.photo_quality import FIX, Shown, about_mixed_cameras, about_use, lens_numbers, measure, number
from pop_fast.errors import CaptureError
from pop_fast.io.atomic import check_folder, folder_atomically
from pop_fast.io.image_header import HEIF_SUFFIXES, is_heif, read_exif
from pop_fast.io.images import in_threads, list_images, read_image, sound_jpegs, unreadable_photographs, write_png


@dataclass(frozen=True)
class SfmResult:
    """What structure from motion found.

    Attributes:
        capture: the folder that `load_capture` reads.
        registered: photographs whose camera was found.
        photographs: photographs that were given.
        points: sparse points.
        reprojection_error: mean, px.
        notes: what its owner may not know of the photographs, one line each.
    """

    capture: Path
    registered: int
    photographs: int
    points: int
    reprojection_error: float
    notes: tuple[str, ...] = ()


def photo_folder(root: Path) -> Path:
    """Find the photographs of a capture without cameras: its folder `images`, or the capture itself."""
    return root / "images" if (root / "images").is_dir() else root


def photographs(folder: Path) -> list[Path]:
    """List a folder's photographs, subfolders' too, by name: none of `masks`, of a Polycam export only its own."""
    exported = photographs_of_polycam(folder)
    if exported is not None:
        return list_images(exported)
    return [path for path in list_images(folder) if path.relative_to(folder).parts[0] != "masks"]


def run_sfm(
    photo_dir: str | Path,
    out_dir: str | Path | None = None,
    progress: Progress | None = None,
    *,
    max_size: int = SfmOptions.max_size,
    camera_model: str = SfmOptions.camera_model,
    single_camera: bool | None = SfmOptions.single_camera,
    matcher: Literal["auto", "exhaustive", "sequential"] = SfmOptions.matcher,
    seed: int = SfmOptions.seed,
    overwrite: bool = False,
) -> SfmResult:
    """Find cameras and sparse points, and write them as a COLMAP capture, whole or not at all.

    Args:
        photo_dir: folder of the photographs and their subfolders; if it has a folder `images`, that one.
        out_dir: the capture to make, with copies of the photographs in `images`. Without it, or if it is `photo_dir`,
            `sparse/0` is written next to the photographs: in the parent of a folder named `images`, else in `photo_dir`
            itself.
        progress: called with (stage, done, total) while features, matches and cameras are found.
        max_size: as in `SfmOptions`; the next four too.
        camera_model: COLMAP's name.
        single_camera: whether all photographs share one camera; by default if they have one size and, by EXIF, one
            lens.
        matcher: which pairs of photographs are compared.
        seed: of every random choice.
        overwrite: replace an existing result, if the folder contains nothing else.

    Raises:
        CaptureError: fewer than two photographs, a damaged one, no model with two of them, or a result that would
            replace photographs or files of others.
    """
    photos = Path(photo_dir)
    options = SfmOptions(
        max_size=max_size, camera_model=camera_model, single_camera=single_camera, matcher=matcher, seed=seed
    )
    if not photos.is_dir():
        what = "no such folder; give the folder with the photographs"
        if photos.is_file():
            what = "is a file; 'pop train' takes videos and archives, 'pop frames' makes a folder of a video's frames"
        raise CaptureError(f"{photos}: {what}")
    photos = photo_folder(photos)
    check_camera_model(camera_model)
    capture, target = _place(photos, out_dir)
    names = [path.relative_to(photos) for path in photographs(photos) if not path.resolve().is_relative_to(target)]
    for name in names:
        if any("\ud800" <= letter <= "\udfff" for letter in str(name)):
            raise CaptureError(
                f"{photos / name}: the name is not UTF-8, which COLMAP's files need; rename the photograph"
            )
    if len(names) < 2:
        hint = unreadable_photographs(photos) or "a scene needs two or more that overlap"
        raise CaptureError(f"{photos}: has {len(names)} {number(len(names), 'photograph', 'photographs')}; {hint}")
    in_place = target != capture.resolve()
    own = recognise_result(capture.resolve(), target)
    check_folder(target, overwrite, recognise=own)
    shown = _looked_at(photos, names, progress)
    hopeless = [finding.text for finding in about_use(shown) if finding.state == "bad"]
    if hopeless:
        raise CaptureError(f"{photos}: {'; '.join(hopeless)}")
    mixed = about_mixed_cameras(shown)
    lenses: list[int] = []
    if single_camera is None:
        options = replace(options, single_camera=mixed is None)
        # left to itself, COLMAP takes each photograph that says nothing of its camera to be of a lens of its own
        lenses = [] if mixed is None else lens_numbers(shown)
    with folder_atomically(target, overwrite, recognise=own) as folder:
        sparse = folder if in_place else folder / "sparse"
        with tempfile.TemporaryDirectory(prefix="pop_sfm_") as work, quiet_colmap():
            staged = _stage(photos, names, Path(work))
            best = find_cameras(Search(str(photos), work, staged, options, lenses), progress)
            for image in best.images.values():
                image.name = names[int(Path(image.name).stem)].as_posix()
            (sparse / "0").mkdir(parents=True)
            best.write_binary(sparse / "0")
        if not in_place:
            for name in names:
                (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(photos / name, folder / "images" / name)
        _write_upright(sparse, photos, names)
        write_list(sparse, folder, "sparse/" if in_place else "")
    error = float(best.compute_mean_reprojection_error())
    notes = () if mixed is None or options.single_camera else (mixed.text,)
    return SfmResult(capture, best.num_reg_images(), len(names), best.num_points3D(), error, notes)


def _place(photos: Path, out_dir: str | Path | None) -> tuple[Path, Path]:
    """Say where the capture is made, and which folder is replaced for it: `sparse` in place, else the whole capture."""
    given = photos.resolve()
    # `images` may be a link to where the photographs are
    linked = photos if photos.name == "images" else given
    beside = linked.parent.resolve() if linked.name == "images" else given
    capture = Path(out_dir) if out_dir is not None else beside
    in_place = capture.resolve() in (beside, given)
    if not in_place and given.is_relative_to(capture.resolve()):
        raise CaptureError(
            f"{capture}: holds the photographs of {photos}, which a new capture there would replace; "
            "choose another --out, or none to write sparse/0 next to them"
        )
    target = capture.resolve() / "sparse" if in_place else capture.resolve()
    return capture, target


def _stage(photos: Path, names: list[Path], work: Path) -> list[str]:
    """Give photographs plain numbers for names, because COLMAP's lists of pairs cannot hold a space."""
    (work / "images").mkdir()
    staged: list[str] = []
    for i, name in enumerate(names):
        suffix = name.suffix.lower()
        with open(photos / name, "rb") as file:
            head = file.read(12)
        # COLMAP reads neither HEIC, which may be named .jpg, nor WebP
        foreign = suffix in HEIF_SUFFIXES or is_heif(head) or head[8:] == b"WEBP"
        plain = work / "images" / f"{i:06d}{'.png' if foreign else suffix}"
        staged.append(plain.name)
        if foreign:
            write_png(plain, read_image(photos / name)[:, :, :3])
            continue
        try:
            plain.symlink_to((photos / name).resolve())
        except OSError:  # where links need a privilege
            shutil.copyfile(photos / name, plain)
    return staged


def _looked_at(photos: Path, names: list[Path], progress: Progress | None) -> list[Shown]:
    """Read all photographs once: damaged and useless ones are found before the long work begins."""
    with sound_jpegs([photos / name for name in names]):
        return in_threads(
            lambda name: measure(photos / name, read_image(photos / name), name.as_posix()),
            names,
            "checking photographs",
            progress,
        )


def _write_upright(sparse: Path, photos: Path, names: list[Path]) -> None:
    """Note which photographs their EXIF orientation asks to be turned, in quarter turns clockwise."""
    # a mirrored photograph is not what a camera sees, turned or not
    clockwise = {6: 1, 3: 2, 8: 3}
    turns = {name.as_posix(): clockwise.get(read_exif(photos / name).orientation, 0) for name in names}
    turned = {name: count for name, count in turns.items() if count}
    if turned:
        (sparse / UPRIGHT).write_text(json.dumps(turned, indent=1) + "\n", encoding="utf-8")


_EXHAUSTIVE_UP_TO: Final = 60
_NEIGHBOURS: Final = 10
# where a search places a smaller share of so few photographs, another one follows that takes several times as long
_ENOUGH: Final = 0.9
_AGAIN_UP_TO: Final = 40
# of the second search: the least contrast of a feature, a third of COLMAP's; how many a photograph has, half as many;
# and how much nearer a match is than the next one, where COLMAP asks for 0.8
_PEAK: Final = 0.002
_FEATURES_EACH: Final = 4096
_RATIO: Final = 0.85
# photographs, and the square of it pairs, between two reports of progress
_BATCH: Final = 8
_DONE: Final = b"."
_FEATURES: Final = "finding features in photographs"
_MATCHES: Final = "matching pairs of photographs"
_CAMERAS: Final = "finding cameras of photographs"
_AGAIN: Final = ", again and more thoroughly"
# bytes that a disk has left on which COLMAP, which does not say why it ends, can go on
_SPARE: Final = 4 * 2**20
# letters of what COLMAP says that an error shows
_LONGEST: Final = 300


@dataclass(frozen=True)
class Search:
    """What to search."""

    photos: str  # the folder that messages name
    work: str  # a folder of the search's own, with the photographs in `images`; the model is written to `best`
    names: list[str]  # of the photographs
    options: SfmOptions  # with `single_camera` decided
    lenses: Sequence[int] = ()  # a number for the lens of each photograph; none where `single_camera` says all

    @property
    def database(self) -> Path:
        """COLMAP's database."""
        return Path(self.work, "database.db")

    @property
    def images(self) -> Path:
        """The photographs under plain names."""
        return Path(self.work, "images")


def check_camera_model(name: str) -> None:
    """Refuse the name of a camera model that COLMAP does not have; the CaptureError names those that it has."""
    known = [known for known in require_colmap().CameraModelId.__members__ if known != "INVALID"]
    if name not in known:
        raise CaptureError(f"camera_model is {name!r}; use one of {', '.join(known)}")


def find_cameras(search: Search, progress: Progress | None) -> Any:
    """Find cameras and points in a process of its own, which ends when this one is interrupted or ends.

    Returns:
        The largest model, a `pycolmap.Reconstruction`.

    Raises:
        CaptureError: there is none, or COLMAP failed.
    """
    begin = f"import sys; sys.path.append(sys.argv[1]); from {__name__} import main; main()"
    command = python_command("-c", begin, str(Path(__file__).parents[2]))
    if progress is not None:
        # the other process takes seconds to begin
        progress(_FEATURES, 0, len(search.names))
    with tempfile.TemporaryFile() as log:
        child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log)
        try:
            end = _listen(child, search, progress)
            child.wait()
            if child.stdin is not None:
                with contextlib.suppress(BrokenPipeError):
                    child.stdin.write(_DONE)
                    child.stdin.flush()
        finally:
            child.kill()
            child.wait()
            for pipe in (child.stdin, child.stdout):
                if pipe is not None:
                    with contextlib.suppress(OSError):
                        pipe.close()
        if end is None:
            log.seek(0)
            said = log.read().decode("utf-8", "replace").strip().rpartition("\n")[2]
            end = f"COLMAP failed: its process ended with status {child.returncode} {said}".strip()[:_LONGEST]
            end += f"; fewer threads and smaller images need less memory; {FIX}"
    if end:
        if shutil.disk_usage(search.work).free < _SPARE:
            fix = "free some space, or let TMPDIR name another folder for temporary files"
            raise CaptureError(f"{search.work}: the disk is full, where COLMAP keeps what it finds; {fix}")
        raise CaptureError(f"{search.photos}: {end}")
    return require_colmap().Reconstruction(Path(search.work, "best"))


def _listen(child: subprocess.Popen[bytes], search: Search, progress: Progress | None) -> str | None:
    """Hand over the job and read until its end: "" when a model was found, or an error; None when there was no end."""
    if child.stdin is None or child.stdout is None:
        return None
    with contextlib.suppress(BrokenPipeError):
        child.stdin.write(json.dumps(asdict(search)).encode() + b"\n")
        child.stdin.flush()
    for line in child.stdout:
        word = json.loads(line)
        if not isinstance(word, list):
            return str(word)
        if progress is not None:
            stage, done, total = word
            progress(stage, done, total)
    return None


def main() -> None:
    """Do the job on standard input; the words go to standard output."""
    # Ctrl-C reaches every process of a terminal; the one that waits decides
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    out = os.fdopen(os.dup(1), "w", encoding="ascii")
    os.dup2(2, 1)
    given = json.loads(sys.stdin.buffer.readline())
    search = Search(**given | {"options": SfmOptions(**given["options"])})
    _watch(search)

    def say(word: Any) -> None:
        out.write(json.dumps(word) + "\n")
        out.flush()

    def tell(*report: Any) -> None:
        say(report)

    try:
        with quiet_colmap():
            best = _made(Path(search.work, "best"))
            _best(search, tell).write_binary(best)
            # COLMAP reports no failed write
            read_binary(best)
        say("")
    except CaptureError as error:
        say(str(error))
    except (ValueError, RuntimeError, IndexError, TypeError, MemoryError) as error:
        said = " ".join(str(error).split())[:_LONGEST]
        say(f"COLMAP failed: {said}; {FIX}")


def _watch(search: Search) -> None:
    """Leave a process behind that ends this one, and removes the folder of the search, when the other one is gone.

    A thread could not: COLMAP keeps the interpreter to itself while it computes.
    """
    worker = os.getpid()
    if not hasattr(os, "fork") or os.fork():
        return
    # the other process waits for the end of these too
    os.closerange(1, 64)
    if os.read(0, 1) != _DONE:
        with contextlib.suppress(ProcessLookupError):
            os.kill(worker, signal.SIGKILL)
        shutil.rmtree(search.work, ignore_errors=True)
    os._exit(0)


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def _best(job: Search, tell: Progress) -> Any:
    """Search, and again where too few photographs were placed; keep the model that places more.

    SIFT's round features seldom match where photographs are far apart: of 14 in a ring, 26 degrees apart, 5 were
    placed, of 7 none. The second search fits an ellipse to each feature, takes fainter ones, and looks for more pairs
    along the epipolar lines of the first ones: it placed all of both. On 8 photographs of the fox, of which both place
    all, it took 39 s of one core and the first 7 s.
    """
    models = _models(job, tell, thorough=False)
    n = len(job.names)
    if n <= _AGAIN_UP_TO and max((model.num_reg_images() for model in models), default=0) < _ENOUGH * n:
        for path in (*Path(job.work).glob("database.db*"), *Path(job.work).glob("models")):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        models += _models(job, lambda stage, done, total: tell(stage + _AGAIN, done, total), thorough=True)
    best = max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)
    if best is None or best.num_reg_images() < 2 or best.num_points3D() == 0:
        raise CaptureError(f"no cameras could be found for these {n} photographs; {FIX}")
    return best


def _models(job: Search, tell: Progress, thorough: bool) -> list[Any]:
    _extract(job, tell, thorough)
    _match(job, tell, thorough)
    return _map(job, tell)


def _extract(job: Search, tell: Progress, thorough: bool) -> None:
    """Find features, a few photographs at a time, so that progress can be reported."""
    pycolmap = require_colmap()
    n = len(job.names)
    extraction = pycolmap.FeatureExtractionOptions(max_image_size=job.options.max_size)
    if thorough:
        extraction.sift.estimate_affine_shape = True
        extraction.sift.peak_threshold = _PEAK
        extraction.sift.max_num_features = _FEATURES_EACH
    # listed first and in order, because the threads that find features would number photographs as they finish
    pycolmap.Database.open(job.database).close()
    one = pycolmap.CameraMode.SINGLE
    for lens in sorted(set(job.lenses)) or [None]:
        pycolmap.import_images(
            job.database,
            job.images,
            camera_mode=one if job.lenses or job.options.single_camera else pycolmap.CameraMode.AUTO,
            image_names=[name for i, name in enumerate(job.names) if lens is None or job.lenses[i] == lens],
            options=pycolmap.ImageReaderOptions(camera_model=job.options.camera_model),
        )
    for start in range(0, n, _BATCH):
        tell(_FEATURES, start, n)
        pycolmap.extract_features(
            job.database,
            job.images,
            image_names=job.names[start : start + _BATCH],
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
    tell(_FEATURES, n, n)


def pairs_of(n: int, matcher: str) -> list[tuple[int, int]]:
    """List which photographs to match: all with all, or each with its neighbours by name, near and 2^k further on."""
    if matcher == "exhaustive" or (matcher == "auto" and n <= _EXHAUSTIVE_UP_TO):
        return list(itertools.combinations(range(n), 2))
    steps = {*range(1, _NEIGHBOURS + 1), *(2**k for k in range(_NEIGHBOURS))}
    return sorted((i, i + step) for i in range(n) for step in steps if i + step < n)


def _match(job: Search, tell: Progress, thorough: bool) -> None:
    pycolmap = require_colmap()
    matching = pycolmap.FeatureMatchingOptions(guided_matching=thorough)
    if thorough:
        matching.sift.max_ratio = _RATIO
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job.options.seed
    pairs = pairs_of(len(job.names), job.options.matcher)
    listing = Path(job.work, "pairs.txt")
    for start in range(0, len(pairs), _BATCH**2):
        tell(_MATCHES, start, len(pairs))
        batch = pairs[start : start + _BATCH**2]
        listing.write_text("".join(f"{job.names[i]} {job.names[j]}\n" for i, j in batch), encoding="utf-8")
        pycolmap.match_image_pairs(
            job.database,
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=listing),
            matching_options=matching,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
    tell(_MATCHES, len(pairs), len(pairs))


def _map(job: Search, tell: Progress) -> list[Any]:
    pycolmap = require_colmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = job.options.seed
    options.mapper.random_seed = job.options.seed
    options.triangulation.random_seed = job.options.seed
    options.min_model_size = 3
    # bundle adjustment adds in the order in which its threads finish: one thread gives the same bits every time
    options.num_threads = 1
    options.mapper.num_threads = 1
    options.ba_min_num_residuals_for_cpu_multi_threading = 2**31 - 1
    found = [0]

    def advance(by: int) -> Callable[[], None]:
        def callback() -> None:
            found[0] += by
            tell(_CAMERAS, min(found[0], len(job.names)), len(job.names))

        return callback

    tell(_CAMERAS, 0, len(job.names))
    out = _made(Path(job.work, "models"))
    models: dict[int, Any] = pycolmap.incremental_mapping(
        job.database,
        job.images,
        out,
        options=options,
        initial_image_pair_callback=advance(2),
        next_image_callback=advance(1),
    )
    return list(models.values())


UPRIGHT = "upright.json"
_LIST = "sfm.sha256"


def write_list(sparse: Path, folder: Path, prefix: str = "") -> None:
    """List every file of a new result `folder` in its folder `sparse`, with `prefix` before their paths."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    lines = [f"{_sha256(path)}  {prefix}{path.relative_to(folder).as_posix()}\n" for path in files]
    (sparse / _LIST).write_text("".join(lines), encoding="utf-8", errors="surrogateescape")


def read_upright(sparse: Path) -> dict[str, int]:
    """Read by how many quarter turns clockwise photographs are to be turned, by name; others are absent."""
    path = sparse / UPRIGHT
    if not path.is_file():
        return {}
    fix = "run pop sfm again with --overwrite"
    try:
        turns = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise CaptureError(f"{path}: is not JSON ({error}); {fix}") from error
    if not isinstance(turns, dict) or not all(type(count) is int and 1 <= count <= 3 for count in turns.values()):
        raise CaptureError(f"{path}: must hold quarter turns, 1 to 3, by the photograph's name; {fix}")
    return turns


def recognise_result(capture: Path, target: Path) -> Callable[[Path], bool]:
    """Make a test of whether a file, by its path relative to the `target` to be replaced, is as it was written."""
    listing = capture / "sparse" / _LIST
    text = listing.read_text(encoding="utf-8", errors="surrogateescape") if listing.is_file() else ""
    written = {name: digest for digest, _, name in (line.partition("  ") for line in text.splitlines())}

    def recognise(file: Path) -> bool:
        path = target / file
        if path.is_symlink():
            return False
        name = path.relative_to(capture).as_posix()
        return name == f"sparse/{_LIST}" or (name in written and written[name] == _sha256(path))

    return recognise


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
