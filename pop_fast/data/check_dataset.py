"""What `pop data check` finds out about a capture before anything is trained on it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pop_fast.data.capture import (
    FAR_APART,
    PosedImage,
    SparsePoints,
    Split,
    held_out,
    nearest_cameras,
    normalizing_transform,
)
from pop_fast.data.colmap import find_model
from pop_fast.data.photo_quality import (
    UNEVEN,
    CaptureFinding,
    Shown,
    State,
    about_mixed_cameras,
    about_number,
    about_use,
    bad,
    exposures,
    levels_at,
    measure,
    number,
    ok,
    warn,
)
from pop_fast.data.read_images import (
    camera_of,
    find_masks,
    fix_of_absent,
    listed_twice,
    read_fitting_mask,
    undistortion,
)
from pop_fast.data.sfm import photo_folder
from pop_fast.errors import CaptureError
from pop_fast.io.images import list_images, read_image, read_mask, unreadable_photographs

# bytes of a Gaussian in training: 59 float32 numbers, each with its gradient and two moments of Adam
BYTES_IN_TRAINING = 59 * 4 * 4
# pairs of neighbouring cameras far apart that are named
_GAPS = 3
# px of a picture that a lens is tried on
_SIDE = 64
# px, of SSIM: that of `pop_fast.stages.losses`, which needs torch
_WINDOW = 11
# px, more than any picture has: COLMAP's error of what lies behind a camera is the largest number
_BEHIND = 1e9


@dataclass(frozen=True)
class Photo:
    """What the file of one shot holds; `size` is (0, 0) where there is none or it cannot be read."""

    shot: PosedImage
    path: Path | None
    size: tuple[int, int] = (0, 0)
    alpha: bool = False
    problem: str = ""
    shown: Shown | None = None
    # brightness at the points that the shot sees, stops; None where that is not known
    levels: np.ndarray | None = None


def read_photo(shot: PosedImage, path: Path | None, cloud: SparsePoints | None = None) -> Photo:
    """Decode and measure the photograph of a shot, found at `path`, and its brightness at the points that it sees."""
    if path is None:
        return Photo(shot, None, problem="absent")
    try:
        image = read_image(path)
    except CaptureError as error:
        return Photo(shot, path, problem=str(error))
    size, alpha = (image.shape[1], image.shape[0]), image.shape[2] == 4
    levels = None
    if cloud is not None and shot.seen is not None and shot.camera is not None and shot.camera.width > 0:
        points = cloud.xyz[shot.seen] @ shot.viewmat[:3, :3].T + shot.viewmat[:3, 3]
        places = np.full((len(points), 2), np.nan)
        front = points[:, 2] > 0.0
        places[front] = shot.camera.img_from_cam(points[front]) if front.any() else 0.0
        levels = levels_at(image, places * (np.array(size) / (shot.camera.width, shot.camera.height)))
    shown = measure(path, image, shot.name)
    return Photo(shot, path, size, alpha, shown=shown, levels=levels)


def about_cameras(shots: Sequence[PosedImage]) -> Iterator[CaptureFinding]:
    kinds: Counter[str] = Counter()
    for shot in shots:
        camera = shot.camera
        if camera is None:
            kinds[f"pinhole with a field of view of {np.degrees(shot.angle_x or 0.0):.1f} degrees"] += 1
        else:
            kinds[f"{camera.model_name} {camera.width}x{camera.height}, f = {camera.mean_focal_length():.1f} px"] += 1
    for kind, count in kinds.most_common(8):
        yield ok("cameras", f"{count} x {kind}")
    if len(kinds) > 8:
        yield ok("cameras", f"and {len(kinds) - 8} more kinds")
    lenses = {(c.model_name, tuple(c.params), c.width, c.height): shot for shot in shots if (c := shot.camera)}
    for shot in lenses.values():
        try:
            # whether it folds the image does not depend on the size
            undistortion(shot.camera, _SIDE, _SIDE)
        except ValueError as error:
            yield bad("cameras", f"{shot.name}: its camera {shot.camera.camera_id} {error}")


def about_places(shots: Sequence[PosedImage], cloud: SparsePoints | None) -> Iterator[CaptureFinding]:
    """Tell what stands against a frame to train in."""
    try:
        if len(shots) > 1:
            normalizing_transform(np.stack([shot.viewmat for shot in shots]), cloud.xyz if cloud else None)
    except CaptureError as error:
        yield bad("poses", str(error))


def about_split(shots: Sequence[PosedImage]) -> Iterator[CaptureFinding]:
    """Tell how many views a capture's own lists leave to train on, where it has any."""
    splits: list[Split | None] = [shot.split for shot in shots]
    if any(split is not None for split in splits):
        out = f"{sum(held_out(splits, 0))} of {len(shots)} held out by its own lists"
        none = "its own lists hold all out: name photographs to train on there"
        yield ok("split", f"{splits.count('train')} to train on, {out}") if "train" in splits else bad("split", none)


def about_spacing(shots: Sequence[PosedImage]) -> Iterator[CaptureFinding]:
    """Tell how far apart neighbouring cameras are, and which stand farthest from the nearest other one.

    A gap between two groups of cameras that stand close together each is not seen.
    """
    found = nearest_cameras(np.stack([shot.viewmat for shot in shots])) if shots else None
    if found is None:
        return
    nearest, degrees = found
    median = float(np.median(degrees))
    gaps: dict[tuple[int, int], str] = {}
    for k in np.argsort(-degrees, kind="stable").tolist():
        first, second = sorted((k, int(nearest[k])))
        gap = f"{degrees[k]:.0f} degrees between {shots[first].name} and {shots[second].name}"
        gaps.setdefault((first, second), gap)
    apart = f"neighbours {median:.1f} degrees apart as seen from the subject (median)"
    if median <= FAR_APART:
        yield ok("spacing", f"{apart}; at most {next(iter(gaps.values()))}")
        return
    wide = ", ".join(list(gaps.values())[:_GAPS])
    yield warn("spacing", f"{apart}: far; photographs between these would help most: {wide}")


def about_photos(photos: Sequence[Photo], root: Path, images: str | None = None) -> Iterator[CaptureFinding]:
    """Tell which photographs are absent, damaged, of another size, rotated by EXIF, or not listed.

    They are those in the folder `images` in place of the listed ones if given.
    """
    yield _listed(photo.size for photo in photos if photo.size != (0, 0))
    absent = [photo for photo in photos if photo.path is None]
    if absent:
        names = ", ".join(photo.shot.name for photo in absent[:3])
        fix = fix_of_absent(root, [photo.shot for photo in absent], [photo.shot for photo in photos])
        yield bad("photographs", f"{len(absent)} of {len(photos)} listed are absent, first {names}; {fix}")
    for photo in photos:
        if photo.path is not None and photo.problem:
            yield bad("photographs", photo.problem)
    twice = listed_twice([photo.shot for photo in photos], [photo.path for photo in photos])
    if twice is not None:
        yield bad("photographs", twice)
    yield from _about_small(photos)
    yield from _about_sizes(photos)
    turned = sum(photo.shot.turns > 0 for photo in photos)
    if turned:
        yield ok("EXIF", f"{turned} are stored rotated and shown upright, as pop sfm noted")
    asking = [photo for photo in photos if photo.shown is not None and photo.shown.exif.orientation != 1]
    rotated = [photo.shot.name for photo in asking if not photo.shot.turns]
    if rotated:
        note = "the pixels are used as stored, as COLMAP does; poses must have been made so too"
        yield warn("EXIF", f"{len(rotated)} ask to be rotated, first {rotated[0]}: {note}")
    with_alpha = sum(photo.alpha for photo in photos)
    if with_alpha:
        yield ok("alpha", f"{with_alpha} photographs have it: composited over the background, no mask")
    yield from _about_unlisted(photos, root, {images} if images else {photo.shot.folder for photo in photos})


def _listed(sizes: Iterable[tuple[int, int]]) -> CaptureFinding:
    """List the sizes of the photographs that could be read, the most frequent four with their numbers."""
    counts = Counter(sizes)
    found = [f"{count} of {w}x{h} px" for (w, h), count in counts.most_common(4)]
    if len(counts) > 4:
        found.append(f"and {sum(counts.values()) - sum(n for _, n in counts.most_common(4))} of other sizes")
    return CaptureFinding("ok" if found else "bad", "photographs", ", ".join(found) or "none could be read")


def _about_small(photos: Sequence[Photo]) -> Iterator[CaptureFinding]:
    """Tell which photographs SSIM finds no whole window in, by which a training is measured."""
    small = [photo.shot.name for photo in photos if 0 < min(photo.size) < _WINDOW]
    if small:
        what = f"{len(small)} of {len(photos)} are smaller than SSIM's window of {_WINDOW}x{_WINDOW} px"
        yield bad("sizes", f"{what}, first {small[0]}: use larger ones, or leave these out of the list")


def _about_sizes(photos: Sequence[Photo]) -> Iterator[CaptureFinding]:
    """Tell how many photographs have another size than their camera: of the same shape, and of another one."""
    alike: list[str] = []
    odd: list[str] = []
    for photo in photos:
        camera, (width, height) = photo.shot.camera, photo.size
        if camera is None or photo.problem or camera.width < 1 or (width, height) == (camera.width, camera.height):
            continue
        same_shape = abs(width * camera.height - height * camera.width) <= max(camera.width, camera.height)
        text = f"{photo.shot.name} is {width}x{height} px, its camera {camera.width}x{camera.height}"
        (alike if same_shape else odd).append(text)
    if alike:
        count = f"{len(alike)} of {len(photos)} have another size than their camera"
        yield ok("sizes", f"{count} and the same shape: K is scaled to fit; first {alike[0]}")
    if odd:
        count = f"{len(odd)} of {len(photos)} have another shape than their camera"
        fix = "cropped or rotated since the poses were made: use the photographs that these were made from"
        yield bad("sizes", f"{count}, {fix}; first {odd[0]}")


def _about_unlisted(photos: Sequence[Photo], root: Path, folders: set[str]) -> Iterator[CaptureFinding]:
    used = {photo.path.resolve() for photo in photos if photo.path is not None}
    for folder in sorted(folders):
        if folder and (root / folder).is_dir():
            spare = [path.name for path in list_images(root / folder) if path.resolve() not in used]
            if spare:
                yield warn("pairing", f"{len(spare)} files in {folder}/ are not listed, first {spare[0]}")


def about_masks(photos: Sequence[Photo], root: Path) -> Iterator[CaptureFinding]:
    """Tell how many masks there are and how much they keep; white means keep."""
    folder = root / "masks"
    kept: list[float] = []
    lone: list[str] = []
    found = find_masks(folder if folder.is_dir() else None, [photo.shot for photo in photos])
    for photo, path in zip(photos, found, strict=True):
        if path is None:
            lone.append(photo.shot.name)
            continue
        try:
            fits = photo.size != (0, 0)
            mask = read_fitting_mask(path, photo.size, photo.shot.turns) if fits else read_mask(path)
            kept.append(float(mask.mean()))
        except CaptureError as error:
            yield bad("masks", str(error))
    if not kept:
        if folder.is_dir():
            yield bad("masks", f"{folder} holds none named like a photograph (<name>.png or <name>.jpg.png)")
        return
    mean = float(np.mean(kept))
    text = f"{len(kept)} masks keep {100 * mean:.0f} % of the pixels (white = keep)"
    yield warn("masks", f"{text}; are they inverted?") if mean < 0.35 else ok("masks", text)
    if lone:
        yield warn("masks", f"{len(lone)} photographs have none, first {lone[0]}: all of their pixels count")


def about_points(photos: Iterable[Photo], cloud: SparsePoints | None, sample: int = 2000) -> Iterator[CaptureFinding]:
    """Project a sample of the points into every view: poses and points that do not belong together show here."""
    if cloud is None or len(cloud) == 0:
        yield warn("points", "none: training starts from random points in the cameras' view")
        return
    chosen = cloud.xyz[np.random.default_rng(0).permutation(len(cloud))[:sample]]
    shares: dict[str, float] = {}
    for shot, camera in ((photo.shot, camera_of(photo.shot, photo.size)) for photo in photos):
        if camera.width < 1:
            continue
        seen = chosen @ shot.viewmat[:3, :3].T + shot.viewmat[:3, 3]
        front = seen[seen[:, 2] > 1e-6]
        pixels = camera.img_from_cam(front) if len(front) else np.zeros((0, 2))
        inside = np.all((pixels >= 0.0) & (pixels <= [camera.width, camera.height]), axis=1)
        shares[shot.name] = float(inside.sum()) / len(chosen)
    blind = [name for name, share in shares.items() if share == 0.0]
    mean = f"; a view sees {100.0 * float(np.mean(list(shares.values()))):.0f} % of them on average" if shares else ""
    yield ok("points", f"{len(cloud):,}{mean}")
    if blind:
        yield warn("points", f"{len(blind)} views see none, first {blind[0]}: are these poses right?")


def about_reprojection(root: Path) -> Iterator[CaptureFinding]:
    """Tell the mean reprojection error of the model's tracks, where it has any."""
    from pop_fast.data.cameras import require_colmap
    from pop_fast.data.colmap import quiet_colmap

    model = find_model(root)
    if model is None:
        return
    try:
        colmap = require_colmap()
    except CaptureError as error:
        yield warn("reprojection", f"not computed: {error}")
        return
    try:
        with quiet_colmap():
            reconstruction = colmap.Reconstruction(model)
            observations = int(reconstruction.compute_num_observations())
            reconstruction.update_point_3d_errors()
            error = float(reconstruction.compute_mean_reprojection_error()) if observations else 0.0
            errors = [point.error for point in reconstruction.points3D.values()]
    # COLMAP holds tracks against each other, and says what does not agree by errors of many kinds, without a file
    except Exception as problem:
        words = " ".join(str(problem).split())
        fix = "their error is unknown, and training takes them as they stand; write the model again to have it measured"
        yield warn("reprojection", f"{model}: COLMAP cannot read its tracks ({words}); {fix}")
        return
    if observations == 0:
        yield ok("reprojection", "the model has no tracks, so its error is unknown")
        return
    behind = sum(each > _BEHIND for each in errors)
    if behind:
        seen = f"{behind:,} of {len(errors):,} points lie behind a camera that saw them"
        yield warn("reprojection", f"{seen}: are these poses right?")
        return
    state: State = "ok" if error < 2.0 else "warn"
    yield CaptureFinding(state, "reprojection", f"mean error {error:.2f} px over {observations:,} observations")


def about_drift(photos: Sequence[Photo]) -> Iterator[CaptureFinding]:
    """Tell how much the photographs differ in brightness where they see the same points."""
    known = [photo for photo in photos if photo.levels is not None and photo.shot.seen is not None]
    seen = [photo.shot.seen for photo in known if photo.shot.seen is not None]
    found = exposures([photo.levels for photo in known if photo.levels is not None], seen)
    width, uneven = found.drift, found.unevenness(np.array([photo.shot.viewmat for photo in known]))
    if width is None:
        return
    extremes = (int(np.nanargmin(found.stops)), int(np.nanargmax(found.stops)))
    ends = [f"{found.stops[i]:+.2f} ({known[i].shot.name})" for i in extremes]
    text = f"the same points differ by {width:.2f} stops from photograph to photograph, {ends[0]} to {ends[1]}"
    text += "" if uneven is None else f"; a photograph differs by {uneven:.2f} from those taken next to it"
    bad = uneven is not None and uneven > UNEVEN
    fix = "; lock the exposure, or train with --exposure" if bad else ""
    yield CaptureFinding("warn" if bad else "ok", "exposure", text + fix)


def about_memory(photos: Sequence[Photo], cloud: SparsePoints | None, free: int) -> Iterator[CaptureFinding]:
    """Estimate the memory that photographs take at each factor, and Gaussians in training."""
    pixels = sum(photo.size[0] * photo.size[1] for photo in photos)
    by_factor = ", ".join(f"{3 * pixels / f**2 / 1e6:,.0f} MB at factor {f}" for f in (1, 2, 4, 8))
    too_much = free > 0 and 3 * pixels > 0.7 * free
    yield CaptureFinding("warn" if too_much else "ok", "memory", f"photographs take {by_factor}")
    start = f"; training starts with {len(cloud):,}" if cloud is not None else ""
    yield ok("memory", f"Gaussians take {BYTES_IN_TRAINING:,.0f} MB a million{start}")


def about_bare(root: Path, shown: Sequence[Shown]) -> Iterator[CaptureFinding]:
    """Tell what there is where nothing says where the photographs were taken."""
    sound = [one for one in shown if not one.problem]
    enough = len(sound) >= 2
    fix = (
        "pop train finds their cameras first, or pop sfm alone" if enough else "a scene needs two or more that overlap"
    )
    count = f"{len(sound)} {number(len(sound), 'photograph', 'photographs')}"
    yield CaptureFinding("ok" if enough else "bad", "poses", f"none yet, {count}: {fix}")
    yield _listed(one.size for one in sound)
    for one in shown:
        if one.problem:
            yield bad("photographs", one.problem)
    if enough:
        yield from about_number(len(sound))
    yield from about_use(sound)
    mixed = about_mixed_cameras(sound)
    if mixed is not None:
        yield mixed
    left = unreadable_photographs(photo_folder(root))
    if left:
        yield warn("photographs", left)
    turned = sum(one.exif.orientation in (3, 6, 8) for one in sound)
    if turned:
        yield ok("EXIF", f"{turned} are stored rotated; training uses them upright")
