"""What a capture is to the rest of the program: pinhole views with their photographs, sparse points, and their frame.

Conventions: OpenCV cameras (+x right, +y down, +z forward); pixel centres at +0.5, so that the point (0, 0) of an
image is its outer corner, `K` of an image resized by s is exactly diag(s, s, 1) K, and COLMAP's intrinsics are used as
they are stored.

The world of a capture is put into the frame that gsplat trains in by three similarities: (1) turn the mean up direction
of the cameras to -y, put the origin at the median of the points of the optical axes that are nearest to the capture's
origin, and scale the median camera distance to 1; (2) turn the principal axes of the sparse points to x, y, z in order
of falling variance, origin at their median; (3) turn half round about x where the points lie above their middle,
because a scene has more points near its floor.

Source: gsplat v1.5.3, examples/datasets/normalize.py and colmap.py. Departs: the signs of the principal axes, which
gsplat leaves to LAPACK, are fixed so that the largest entry of the x and y axes is positive; and where the capture's
origin is that of a map, far from all cameras, (1) takes the points that are nearest to the cameras' median instead.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from pop_fast.data.cameras import affine
from pop_fast.errors import CaptureError

Split = Literal["train", "val", "test"]
# what lists the cameras; "auto" takes the first that is there
Source = Literal["auto", "colmap", "transforms", "polycam", "metashape", "realitycapture", "photos"]
# called from the main thread with (what is being done, how many are done, of how many)
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class View:
    """One photograph and its pinhole camera.

    Attributes:
        name: relative file name, with forward slashes; unique in a capture.
        image: undistorted, downscaled, composited over the background where it had alpha. uint8 [H, W, 3]
        viewmat: world -> camera, rigid. float64 [4, 4]
        K: intrinsics in px. float64 [3, 3]
        mask: True where the photograph counts; None where all of it does. bool [H, W]
        split: the capture's own assignment, or None where every n-th file is held out.
        alpha: opacity of a photograph with transparency, which `image` has laid over the background, of 255; None
            where the file has none. uint8 [H, W]
        seen: rows of the capture's points that this photograph sees, by the tracks of the search for cameras; None
            where there are no tracks. int32 [M]
        was_read: False where only the camera was asked for; `image` then has the right size and no content.
    """

    name: str
    image: np.ndarray
    viewmat: np.ndarray
    K: np.ndarray
    mask: np.ndarray | None = None
    split: Split | None = None
    alpha: np.ndarray | None = None
    was_read: bool = True
    seen: np.ndarray | None = None

    @property
    def width(self) -> int:
        return int(self.image.shape[1])

    @property
    def height(self) -> int:
        return int(self.image.shape[0])

    @property
    def camera_center(self) -> np.ndarray:
        """The camera's position in the world: -R^T t. float64 [3]"""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def __repr__(self) -> str:
        mask = "" if self.mask is None else ", masked"
        return f"View({self.name!r}, {self.width}x{self.height}{mask})"

    def _repr_html_(self) -> str:
        """Show the photograph in a notebook, with sides of up to 480 px."""
        from pop_fast.io.images import data_uri, fit

        picture = data_uri(fit(self.image, max_side=480), lossless=True)
        return f'<figure><img src="{picture}"><figcaption>{html.escape(repr(self))}</figcaption></figure>'


@dataclass(frozen=True, eq=False)
class Capture:
    """A loaded capture.

    Attributes:
        name: the folder's name.
        views: sorted by file name.
        points: sparse points in the same world as the views. float64 [P, 3]
        points_rgb: their colours. uint8 [P, 3]
        source: one line that says where poses and points come from.
        world_transform: similarity, world = world_transform @ capture's own frame; the identity where the capture was
            loaded with `normalize=False`. float64 [4, 4]
        notes: what was skipped, chosen or made up while loading, one line each.
        sfm_seconds: how long its cameras were searched for, where they were not there before; else None.
        unplaced: how many photographs of its folder have no camera, where a COLMAP model lists the cameras.
    """

    name: str
    views: tuple[View, ...]
    points: np.ndarray
    points_rgb: np.ndarray
    source: str
    world_transform: np.ndarray = field(default_factory=lambda: np.eye(4))
    notes: tuple[str, ...] = ()
    sfm_seconds: float | None = None
    unplaced: int = 0

    def __post_init__(self) -> None:
        if len(self.views) < 2:
            count = "1 view" if self.views else "no views"
            raise CaptureError(f"{self.name}: has {count}; a scene needs two or more")
        object.__setattr__(self, "views", tuple(sorted(self.views, key=lambda view: view.name)))

    def __repr__(self) -> str:
        return f"Capture({self.name!r}, {len(self.views)} views, {len(self.points):,} points, {self.source!r})"

    def _repr_html_(self) -> str:
        """Show up to eight of the photographs in a notebook, from the first to the last."""
        from pop_fast.io.images import data_uri, fit

        places = np.unique(np.linspace(0, len(self.views) - 1, 8).round().astype(int))
        notes = "".join(f"<li>{html.escape(note)}</li>" for note in self.notes)
        pictures = " ".join(
            f'<img src="{data_uri(fit(self.views[i].image, max_side=160), lossless=True)}">' for i in places
        )
        return f"<p>{html.escape(repr(self))}</p><p>{pictures}</p><ul>{notes}</ul>"

    @property
    def world_scale(self) -> float:
        """Length of one unit of the capture's own frame in this world: det(world_transform[:3, :3])^(1/3)."""
        return float(np.cbrt(np.linalg.det(self.world_transform[:3, :3])))

    @property
    def camera_centers(self) -> np.ndarray:
        """Positions of all cameras. float64 [V, 3]"""
        return np.stack([view.camera_center for view in self.views])

    def scene_scale(self) -> float:
        """Measure the scene as gsplat does: 1.1 * max_k |c_k - mean(c)| over all cameras, train and test."""
        centers = self.camera_centers
        return float(1.1 * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())

    @property
    def has_own_split(self) -> bool:
        """Whether the capture's own lists say which views are held out, and `test_every` says nothing."""
        return any(view.split is not None for view in self.views)

    def train_views(self, test_every: int = 8) -> tuple[View, ...]:
        """Select the views to train on: all that `test_views` leaves, validation views apart."""
        if self.has_own_split:
            return tuple(view for view in self.views if view.split == "train")
        return tuple(view for i, view in enumerate(self.views) if test_every <= 0 or i % test_every != 0)

    def test_views(self, test_every: int = 8) -> tuple[View, ...]:
        """Select the views to hold out.

        The capture's own split where it has one (its validation views where it names no test views); otherwise every
        `test_every`-th view by file name, starting with the first (index % test_every == 0), as 3DGS and gsplat.

        Args:
            test_every: 8 in the paper; 0 holds nothing out.
        """
        chosen = held_out([view.split for view in self.views], test_every)
        return tuple(view for view, out in zip(self.views, chosen, strict=True) if out)


def held_out(splits: Sequence[Split | None], test_every: int) -> list[bool]:
    """Tell which views are held out, by the capture's own assignment in the order of their names; see `test_views`."""
    if any(split is not None for split in splits):
        chosen = "test" if "test" in splits else "val"
        return [split == chosen for split in splits]
    return [test_every > 0 and i % test_every == 0 for i in range(len(splits))]


@dataclass(frozen=True, eq=False)
class PosedImage:
    """One listed photograph."""

    name: str  # as listed; unique, and what views are sorted by
    folder: str  # the image folder, relative to the capture; "" for the capture itself
    file: str  # relative name in that folder; the extension may differ from the file's
    camera: Any  # a `PinholeCamera` or `pycolmap.Camera`, or None where only the field of view is known
    viewmat: np.ndarray  # world -> camera, rigid. float64 [4, 4]
    angle_x: float | None = None  # horizontal field of view in radians, where `camera` is None
    mask: Path | None = None  # the mask file that the list names, if any
    split: Split | None = None  # the list's own assignment, if any
    # quarter turns clockwise that make the photograph upright; `camera` and `viewmat` are those of its pixels
    # as they are stored
    turns: int = 0
    # rows of the sparse points that it sees; None where that is not known. int32 [M]
    seen: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """Sparse points: places float64 [P, 3], colours uint8 [P, 3]."""

    xyz: np.ndarray
    rgb: np.ndarray

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, eq=False)
class Listing:
    """What a capture lists, its photographs not read."""

    root: Path  # the folder that the photographs' folders are in
    path: Path  # the file or model that lists them, for messages
    shots: list[PosedImage]  # where each was taken
    cloud: SparsePoints | None  # sparse points; None where there are none
    made_from: str  # what kind of list it is
    notes: list[str] = field(default_factory=list)  # one line each
    # the training frame, where that is decided already; None normalizes. float64 [4, 4]
    transform: np.ndarray | None = None
    sfm_seconds: float | None = None  # how long the cameras were searched for, where that was done now
    unplaced: int = 0  # photographs of the folder that have no camera


# of a point from the middle of all, times the median camera distance
_FARTHEST: Final = 1e100


def transform_points(transform: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Move points by a similarity: p' = s R p + t. float64 [P, 3]"""
    return points @ transform[:3, :3].T + transform[:3, 3]


def transform_viewmats(transform: np.ndarray, viewmats: np.ndarray) -> np.ndarray:
    """Move cameras [V, 4, 4] by a similarity of the world [4, 4], and keep their view matrices rigid.

    With R, s, t of the similarity and c' = s R c + t the new centre: rotation' = rotation R^T, viewmat' = [rotation',
    -rotation' c'].
    """
    linear = transform[:3, :3]
    scale = np.cbrt(np.linalg.det(linear))
    rotations = viewmats[:, :3, :3] @ (linear / scale).T
    centers = transform_points(transform, camera_centers(viewmats))
    moved = viewmats.copy()
    moved[:, :3, :3] = rotations
    moved[:, :3, 3] = -np.einsum("vij,vj->vi", rotations, centers)
    return moved


def normalizing_transform(viewmats: np.ndarray, points: np.ndarray | None) -> np.ndarray:
    """Find the similarity, normalised world from the capture's own, by viewmats [V, 4, 4] and sparse points [P, 3].

    Without points, or with fewer than four, only step (1) is taken.

    Raises:
        CaptureError: the cameras have no extent or no common up direction, or points are too far away.
    """
    transform = _from_cameras(viewmats)
    if points is None or len(points) < 4:
        return transform
    transform = _along_principal_axes(transform_points(transform, points)) @ transform
    heights = transform_points(transform, points)[:, 2]
    if np.median(heights) > np.mean(heights):
        transform = np.diag([1.0, -1.0, -1.0, 1.0]) @ transform
    return transform


def camera_centers(viewmats: np.ndarray) -> np.ndarray:
    """Give the cameras' centres in the world: c = -R^T t. [V, 3]"""
    return -np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])


def focus_point(viewmats: np.ndarray) -> np.ndarray:
    """Give the point nearest to all optical axes: sum_i (I - d_i d_i^T)(x - c_i) = 0.

    Parallel axes meet nowhere, and those that spread meet behind the cameras; then it is the point one mean camera
    distance ahead of the cameras' mean.
    """
    centers, forward = camera_centers(viewmats), viewmats[:, 2, :3]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.cond(total) < 1e6:
        focus = np.linalg.solve(total, np.einsum("mij,mj->i", across, centers))
        if np.median(np.einsum("mj,mj->m", focus - centers, forward)) > 0.0:
            return focus
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).mean())
    return centers.mean(axis=0) + (spread or 1.0) * forward.mean(axis=0)


# four of five cameras of ten captures look past the point by up to 13 degrees where people went round a subject; by 49
# to 155 on a walk, in rooms photographed from their middle, and from the air
_LOOKS_AT: Final = np.radians(25.0)
_MOST_CAMERAS: Final = 0.8


def look_at_one_point(viewmats: np.ndarray) -> bool:
    """Tell whether four of five cameras look at `focus_point`, as those do that went round a subject. [V, 4, 4]

    Those that walk towards a point look at it too, and are told apart: their distances from it spread more (standard
    deviation) than they stand across their mean direction from it (root of the mean square). Of nine captures of a
    subject, a room and a facade that quotient is up to 0.29, of a walk down a lane 2.5.
    """
    rays = focus_point(viewmats) - camera_centers(viewmats)
    distances = np.maximum(np.linalg.norm(rays, axis=1), 1e-12)
    cosines = np.einsum("mj,mj->m", rays, viewmats[:, 2, :3]) / distances
    if np.mean(cosines >= np.cos(_LOOKS_AT)) < _MOST_CAMERAS:
        return False
    mean = (rays / distances[:, None]).mean(axis=0)
    along = rays @ (mean / max(float(np.linalg.norm(mean)), 1e-12))
    across = np.sqrt(np.maximum(distances**2 - along**2, 0.0).mean())
    return bool(np.std(distances) <= across or len(rays) == 1)


# degrees between neighbouring cameras from which what lies between them is guessed
FAR_APART: Final = 15.0


def nearest_cameras(viewmats: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Find the nearest other camera of each, as the point that they look at sees them, and the angle to it in degrees.

    [V] each; None of a single camera, and where they look at no one point.
    """
    if len(viewmats) < 2 or not look_at_one_point(viewmats):
        return None
    offsets = camera_centers(viewmats) - focus_point(viewmats)
    rays = offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-12)
    cosines = rays @ rays.T
    np.fill_diagonal(cosines, -1.0)
    return cosines.argmax(axis=1), np.degrees(np.arccos(np.clip(cosines.max(axis=1), -1.0, 1.0)))


def neighbour_degrees(viewmats: np.ndarray) -> float | None:
    """Give the median of the angles of `nearest_cameras`, degrees; None where there are none."""
    found = nearest_cameras(viewmats)
    return None if found is None else float(np.median(found[1]))


# of the cameras from the median of what is nearest to the capture's origin, in their own distances from their middle:
# beyond, the origin is not where they look but that of a map, and near the cameras is looked instead. Up to 80 times,
# training by gsplat's rule was as good as at the origin; at the 1,000,000 times of UTM all lay before the near plane
_FARTHEST_FOCUS: Final = 100.0


def _from_cameras(viewmats: np.ndarray) -> np.ndarray:
    # the rows of a view matrix are the camera's axes in the world: x right, y down, z forward
    up = -viewmats[:, 1, :3].mean(axis=0)
    length = np.linalg.norm(up)
    turn = _rotation_between(up / length, np.array([0.0, -1.0, 0.0])) if length > 1e-6 else np.eye(3)
    centers = camera_centers(viewmats) @ turn.T
    forwards = viewmats[:, 2, :3] @ turn.T
    middle = np.median(centers, axis=0)
    apart = float(np.median(np.linalg.norm(centers - middle, axis=1)))
    for start in (np.zeros(3), middle):
        own = centers - start
        origin = np.median(own - np.sum(forwards * own, axis=1, keepdims=True) * forwards, axis=0) + start
        distance = float(np.median(np.linalg.norm(centers - origin, axis=1)))
        if distance <= _FARTHEST_FOCUS * apart:
            break
    spread = float(np.ptp(centers, axis=0).max())
    if spread <= 1e-9 * max(1.0, float(np.abs(centers).max())) or distance == 0.0:
        raise CaptureError("all cameras are at one place; a scene needs photographs from different places")
    return affine(turn / distance, -origin / distance)


def _rotation_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Rotate unit vector a onto unit vector b by the shortest way: I + [v] + [v]^2 / (1 + a.b), v = a x b."""
    cosine = float(a @ b)
    if cosine <= -1.0 + 1e-12:
        return np.diag([-1.0, -1.0, 1.0])
    x, y, z = np.cross(a, b)
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + skew + skew @ skew / (1.0 + cosine)


def principal_axes(spread: np.ndarray) -> np.ndarray:
    """Return the directions of falling spread, the first two with their largest entry positive. [3, 3] of [3, 3]"""
    _, axes = np.linalg.eigh(spread)
    found = axes.T[::-1].copy()
    for row in found[:2]:
        if row[np.argmax(np.abs(row))] < 0.0:
            row *= -1.0
    return found


def _along_principal_axes(points: np.ndarray) -> np.ndarray:
    middle = np.median(points, axis=0)
    # the square of what is too far is no float
    farthest = float(np.abs(points - middle).max())
    if not farthest < _FARTHEST:
        raise CaptureError(
            f"in units of the cameras' distance, points lie up to {farthest:.3g} from their middle, which cannot be "
            "normalized; correct the positions of cameras and points, or use --no-normalize"
        )
    rotation = principal_axes(np.cov(points - middle, rowvar=False))
    rotation[2] = np.cross(rotation[0], rotation[1])
    return affine(rotation, -rotation @ middle)


MATCHERS: Final = ("auto", "exhaustive", "sequential")


@dataclass(frozen=True, kw_only=True)
class SfmOptions:
    """How cameras are found.

    Attributes:
        max_size: longest side at which features are looked for, px; cameras are always in full size.
        camera_model: COLMAP's name of the lens model.
        single_camera: all photographs share one camera; by default when they are of one size and, by EXIF, of one lens.
        matcher: "exhaustive" matches all photographs with all, "sequential" each with its neighbours by name; "auto"
            matches up to 60 exhaustively.
        seed: of every random choice.
    """

    max_size: int = 1600
    camera_model: str = "SIMPLE_RADIAL"
    single_camera: bool | None = None
    matcher: Literal["auto", "exhaustive", "sequential"] = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.max_size < 64:
            raise CaptureError(f"max_size is {self.max_size}; it must be at least 64 px, or there are no features")
        if self.matcher not in MATCHERS:
            raise CaptureError(f"matcher is {self.matcher!r}; use one of {', '.join(MATCHERS)}")
        if not 0 <= self.seed < 2**31:
            raise CaptureError(f"seed is {self.seed}; it must be a whole number from 0 to {2**31 - 1}")
