"""Train with the student's own code, the loop included: the toy, a picture, or views of a capture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_ref.learn.course import COURSE
from pop_ref.learn.progress import evenly, toy
from pop_ref.learn.splat import SH_C0, l2, orbit, photograph
from pop_ref.learn.student import Borrowed, Work, borrowing, said, where

SIZE: Final = 64
# Gaussians of a capture's far sphere
_FAR: Final = 80
# one view in so many of a capture is put aside, as benchmarks do
_HELD_OUT: Final = 8
# a camera as `records.Camera` takes it, and what it sees, [H, W, 3] in [0, 1]
View = tuple[tuple[np.ndarray, np.ndarray, int, int], np.ndarray]


@dataclass(frozen=True)
class Subject:
    """What is trained on.

    Attributes:
        views: cameras and photographs; training takes one a step, all in a random order, then all again.
        aside: the views that a training is judged by; no step sees them, and the film shows the first.
        params: raw parameters of the Gaussians to start from.
        scene_scale: world units.
    """

    views: Sequence[View]
    aside: Sequence[View]
    params: dict[str, np.ndarray]
    scene_scale: float = 1.0


@dataclass(frozen=True)
class Told:
    """A training on its way.

    Attributes:
        step: number of steps taken.
        loss: of the last of them.
        psnr: dB, of the view that is shown.
        n: Gaussians.
        picture: photograph and render side by side, [H, 2 W, 3].
        psnrs: dB, of all views that are put aside, at the last step; empty before.
    """

    step: int
    loss: float
    psnr: float
    n: int
    picture: np.ndarray
    psnrs: tuple[float, ...] = ()


def the_toy(size: int = SIZE, n_views: int = 8, seed: int = 0) -> Subject:
    """Photograph the toy all around, and start from flat Gaussians on its surfaces, none in place, half as colourful.

    Example:
        >>> len(the_toy(8).views)
        8
    """
    rng = np.random.default_rng(seed)
    cameras = [orbit(2 * np.pi * k / n_views, size) for k in range(n_views)]
    unseen = orbit(np.pi / n_views, size)
    points, n = toy(), len(toy()["means"])
    colors = 0.25 + 0.5 * (SH_C0 * points["sh0"][:, 0] + 0.5) + rng.normal(0.0, 0.05, (n, 3))
    params = {
        **points,
        "means": points["means"] + rng.normal(0.0, 0.02, (n, 3)),
        "scales": points["scales"] + np.log(1.3),
        "opacities": np.full(n, 1.0),
        "sh0": ((colors - 0.5) / SH_C0)[:, None],
    }
    views = [(camera, photograph(camera)) for camera in cameras]
    return Subject(views, [(unseen, photograph(unseen))], params)


def a_picture(image: np.ndarray, size: int = SIZE, cells: int = 16) -> Subject:
    """Stand before a picture and start from a grid of Gaussians, each of the colour of its cell.

    There is one view: the training is judged by what it was trained on.

    Args:
        image: [H, W, 3] in [0, 1]; its middle square is taken.
        size: px, to which it is made smaller.
        cells: Gaussians along each side.

    Raises:
        ValueError: the picture is smaller than `size`.
    """
    side = min(image.shape[:2])
    if side < size:
        raise ValueError(f"the picture is {image.shape[1]} x {image.shape[0]} px; it must be {size} px at least")
    top, left = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
    target = shrunk(image[top : top + side, left : left + side, :3], size, size)
    depth, f = 4.0, 1.2 * size
    x, y = (axis.ravel() for axis in np.meshgrid(*[(np.arange(cells) + 0.5) * size / cells] * 2))
    means = np.stack([(x - size / 2) * depth / f, (y - size / 2) * depth / f, np.full(len(x), depth)], axis=1)
    colors = shrunk(target, cells, cells).reshape(-1, 3)
    K = np.array([[f, 0.0, size / 2], [0.0, f, size / 2], [0.0, 0.0, 1.0]])
    view = (np.eye(4), K, size, size), target
    return Subject([view], [view], _started(means, colors, 0.6 * size / cells * depth / f), 4.0)


def a_capture(
    views: Sequence[View], points: np.ndarray, colors: np.ndarray, scene_scale: float, n: int = 2000
) -> Subject:
    """Start from some of a capture's points, and from a far sphere; every eighth view is put aside, the first too.

    Sky and bare walls have no points, and what no Gaussian covers has no gradient: the sphere covers it.

    Args:
        views: small ones, see `shrunk`.
        points: [N, 3] world units.
        colors: [N, 3] in [0, 1].
        scene_scale: world units.
        n: points that are taken.

    Raises:
        ValueError: there are fewer than two views, or no points.
    """
    if len(views) < 2 or not len(points):
        raise ValueError(
            f"the capture has {len(views)} views and {len(points)} points; two views and a point are needed"
        )
    picked = np.random.default_rng(0).permutation(len(points))[:n]
    means = points[picked]
    centers = np.array([-viewmat[:3, :3].T @ viewmat[:3, 3] for (viewmat, *_), _ in views])
    middle = centers.mean(axis=0)
    radius = 8.0 * max(float(np.linalg.norm(centers - middle, axis=1).max()), 1e-6 * scene_scale)
    sphere = middle + radius * evenly(_FAR)
    # so wide that each reaches its third neighbour
    apart = np.sqrt(np.sum((means[:, None] - means) ** 2, axis=2))
    near = np.sort(apart, axis=1)[:, 1 : min(4, len(means))].mean(axis=1) if len(means) > 1 else np.ones(1)
    widths = np.concatenate([near, np.full(_FAR, radius * np.sqrt(4.0 * np.pi / _FAR))])
    mean_color = np.mean([photo.mean(axis=(0, 1)) for _, photo in views], axis=0)
    tints = np.concatenate([colors[picked], np.tile(mean_color, (_FAR, 1))])
    params = _started(np.concatenate([means, sphere]), tints, 0.4 * widths)
    seen = [view for k, view in enumerate(views) if k % _HELD_OUT]
    return Subject(seen, views[::_HELD_OUT], params, scene_scale)


def shrunk(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Make a picture smaller: the mean of the pixels that fall into each new one.

    Example:
        >>> shrunk(np.array([[[0.0], [1.0]], [[2.0], [3.0]]]), 1, 1)
        array([[[1.5]]])
    """
    rows = np.linspace(0, image.shape[0], height + 1).astype(int)[:-1]
    columns = np.linspace(0, image.shape[1], width + 1).astype(int)[:-1]
    sums = np.add.reduceat(np.add.reduceat(image, rows, axis=0), columns, axis=1)
    counts = np.diff([*rows, image.shape[0]])[:, None] * np.diff([*columns, image.shape[1]])
    return sums / counts[..., None]


def _started(means: np.ndarray, colors: np.ndarray, widths: Any) -> dict[str, np.ndarray]:
    n = len(means)
    return {
        "means": means,
        "quats": np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        "scales": np.log(np.broadcast_to(np.reshape(widths, (-1, 1)), (n, 3))),
        "opacities": np.full(n, 1.5),
        "sh0": ((colors - 0.5) / SH_C0)[:, None],
    }


def train(work: Work, subject: Subject, steps: int = 120, every: int = 10, seed: int = 0) -> Iterator[Told]:
    """Fit the subject, telling at the start and now and then.

    Raises:
        ValueError: there are fewer than 0 steps, or a stage is not written or stops with an error, which is named.
    """
    if steps < 0:
        raise ValueError(f"--steps is {steps}; give 0, for the start alone, or more")
    missing = [stage.name for stage in COURSE if not work.is_whole(stage) and stage.name not in work.unreadable]
    if missing:
        raise ValueError(f"not all is written yet: {', '.join(missing)}; 'pop-learn check' says what each lacks")
    with borrowing(work) as borrowed:
        try:
            yield from _steps(borrowed, subject, steps, every, np.random.default_rng(seed))
        except Exception as error:
            at = where(error, work.folder)
            if at == str(work.folder):
                raise
            raise ValueError(
                f"{at}: it stops with {said(error)}; 'pop-learn check {Path(at.split(',')[0]).stem}'"
            ) from None


def _steps(borrowed: Borrowed, subject: Subject, steps: int, every: int, rng: np.random.Generator) -> Iterator[Told]:
    training, types, recipes = (borrowed.module(name) for name in ("training", "records", "recipes"))
    recipe = recipes.RECIPES["POP"]
    scale = subject.scene_scale
    rates = replace(recipe.lr, means=4e-3, means_decay=0.1, quats=2e-2, scales=4e-2, opacities=1e-1, sh0=4e-2)
    # density control acts once, after a quarter, so that what it adds has time to settle; the prior ends at half time
    density = replace(recipe.density, refine_start_iter=0, refine_every=max(2, steps // 4), refine_stop_iter=steps // 2)
    density = replace(density, grow_grad2d=1e-3)
    recipe = replace(recipe, max_steps=steps, lr=rates, density=density, pop_stop_iter=steps // 2)
    state, loss, waiting = training.start(subject.params), float("nan"), list[int]()
    for step in range(steps + 1):
        if step % every == 0 or step == steps:
            gaussians = training.gaussians_from_params(state.rows.params)
            judged = subject.aside if step == steps else subject.aside[:1]
            images = [borrowed.module("render").render(gaussians, types.Camera(*camera)).image for camera, _ in judged]
            psnrs = tuple(_psnr(image, photo) for image, (_, photo) in zip(images, judged, strict=True))
            beside = np.concatenate([judged[0][1], images[0]], axis=1)
            yield Told(step, loss, psnrs[0], len(gaussians), beside, psnrs if step == steps else ())
        if step < steps:
            # every view once before any comes again
            waiting = waiting or rng.permutation(len(subject.views)).tolist()
            seen, photo = subject.views[waiting.pop()]
            normals = lambda n: rng.standard_normal((2, n, 3))  # noqa: E731
            state, loss = training.train_step(state, types.Camera(*seen), photo, scale, normals, recipe)


def _psnr(image: np.ndarray, photo: np.ndarray) -> float:
    return float(-10.0 * np.log10(l2(np.clip(image, 0.0, 1.0), photo)[0]))
