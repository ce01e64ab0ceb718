"""What a report says about a finished splat, measured by rendering it: overfitting, exposure, floaters; depth, orbit.

The numbers go to report_data/checks_step{step}.json, depth maps to report_data/depth_step{step}_{i}.npz in the order of
the held-out views' pictures, the orbit to videos/orbit_step{step}.webm: a report is made of files alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from pop_fast.data.capture import Capture, View, neighbour_degrees
from pop_fast.data.photo_quality import GAMMA
from pop_fast.density.passes import Passes
from pop_fast.errors import PopError
from pop_fast.io.atomic import write_json
from pop_fast.io.images import fit, to_uint8
from pop_fast.io.read_back import read_json
from pop_fast.stages.appearance import expose
from pop_fast.train.config import TrainConfig
from pop_fast.train.evaluate import measure, psnr
from pop_fast.train.results import ResultFolder
from pop_fast.train.views import Layers, ViewTensors, evenly, render_layers
from pop_fast.view.paths import VideoFile, camera_path

# training views that are rendered, evenly over the capture
_MOST_TRAIN: Final = 12
# of the worst held-out views there are pictures even where `max_renders` ends before them
_WORST: Final = 3
# nearer than this share of the distance of the nearest points, nothing was photographed
_NEAR: Final = 0.5
_NEAREST_POINTS: Final = 0.02  # quantile, as a few points are always wrong
_FEWEST_POINTS: Final = 20
# what covers a pixel by as much is seen
_SEEN: Final = 0.1
# of the orbit's pixels, on average: what hides less is not seen
_HAZE: Final = 1e-5
# training views that a veil is weighed against, evenly over the capture
_MOST_WEIGHED: Final = 40
# in what a capture says of its points, where they were made up
_RANDOM: Final = "random ones"
# a picture's longer side in blocks; of what moved, a block's error is so many times the median block's, and so much of
# full brightness at least. Of women who walked through a hotel and ran through a café such blocks are 4 and 1 % of a
# photograph; of eleven captures in which nothing moved, up to 0.3 %
_BLOCKS: Final = 32
_TIMES_THE_REST: Final = 6.0
_FAR_OFF: Final = 0.06
# a picture's longer side in patches, whose mean colour is compared: fine detail that a splat has not learned yet
# cancels there, and what stood in one photograph alone does not. Where the median patch is farther off than this, the
# whole is not learned yet. Of a box that stands elsewhere in every photograph such patches are 0.4 to 0.9 % of a
# photograph (five runs); of the same scene without it, of the fox and of three trained rows of the bear up to 0.15 %
_PATCHES: Final = 24
_LEARNED: Final = 0.01
_ORBIT_SIDE: Final = 400
_ORBIT_FRAMES: Final = 60
_ORBIT_FPS: Final = 15.0
# what is darker, or as near to white, has lost its brightness
_DARK: Final = 0.08
_MOST_PSNR: Final = 100.0  # dB, of equal images
_FIX: Final = "write it again with 'pop report --check', or remove the file"


@dataclass(frozen=True)
class Checks:
    """What was measured."""

    photographs: int  # training views there are
    train_psnr: float  # mean over the training views that were rendered, dB
    train_measured: int  # how many these are
    held_out_psnr: float | None = None  # mean over the held-out views, dB; None where there are none
    # of each of these views, as `judged_psnr` takes them, dB
    held_out: Mapping[str, float] = field(default_factory=dict)
    # the mean after each channel of each render was scaled to its photograph's brightness, dB
    matched_psnr: float | None = None
    # median over the training cameras of the angle to the nearest other one, seen from the point that they look
    # at
    neighbour_degrees: float | None = None
    # how much brighter each photograph is than its render, in stops of exposure, by view
    stops: Mapping[str, float] = field(default_factory=dict)
    # share of each held-out view's pixels (training views where none is held out) that Gaussians cover by a
    # tenth or more which are nearer than half the distance of the nearest points; empty without points
    floaters: Mapping[str, float] = field(default_factory=dict)
    # the same of the views of the orbit, which stand between the photographs, by their number
    orbit_floaters: Mapping[str, float] = field(default_factory=dict)
    # mean of `held_out` once Gaussians whose centres stand where floaters do are left out, dB; None where there
    # are none, or no such views
    without_floaters: float | None = None
    # share of each rendered training view that is far from its photograph where the rest is near
    misfits: Mapping[str, float] = field(default_factory=dict)
    # share of it whose mean colour is another one than in its photograph where the rest has the same
    patches: Mapping[str, float] = field(default_factory=dict)
    steps: int | None = None  # that were taken; None where an older version has measured
    # whether the run learned each training photograph's exposure, with which those views are measured; `stops`
    # are without
    exposures_learned: bool = False
    given: int | None = None  # photographs that the capture has, with those that have no camera
    placed: int | None = None  # those that have one; None of both where an older version has measured

    @property
    def judged_psnr(self) -> float | None:
        """What held-out views are judged by: after scaling where exposures were learned, of which these have none."""
        return self.matched_psnr if self.exposures_learned else self.held_out_psnr


def write_checks(
    folder: Path,
    capture: Capture,
    params: Mapping[str, Tensor],
    config: TrainConfig,
    sh_degree: int,
    backend: Any,
    step: int,
) -> Checks:
    """Measure a splat, whose last step names the files, and write what a report shows of it."""
    results = ResultFolder(folder)

    def looked(view: View, chosen: Mapping[str, Tensor] = params) -> Layers:
        return render_layers(backend, chosen, ViewTensors.of(view), config, sh_degree)

    train, test = capture.train_views(config.test_every), capture.test_views(config.test_every)
    turn = orbit_views(train)
    some = [train[i] for i in np.unique(np.linspace(0, len(train) - 1, min(len(train), _MOST_TRAIN)).astype(int))]
    learned = results.read_stats("appearance", step) or {}
    seen = {view.name: looked(_from_learned(view, learned)) for view in (*some, *test)}
    held_out = {view.name: _psnr(view, seen[view.name].image) for view in test}
    worst = sorted(held_out, key=lambda name: held_out[name])[: min(_WORST, config.max_renders)]
    for i, view in enumerate(test):
        layers = seen[view.name]
        if i < config.max_renders or view.name in worst:
            stem = f"val_step{step}_{i:04d}"
            # a run that was stopped has measured nothing at its last step
            if not (folder / "report_data" / f"{stem}.npz").is_file():
                _keep_picture(results, stem, view, layers)
            depth = np.where(layers.alpha >= _SEEN, layers.depth / capture.world_scale, np.nan).astype(np.float32)
            results.write_arrays(f"depth_step{step}_{i:04d}", name=view.name, depth=fit(depth, nearest=True))
    fitted = {view.name: _exposed(seen[view.name].image, view, learned) for view in some}
    matched = {view.name: _psnr(view, _matched(view, seen[view.name].image)) for view in test}
    exposures = any("exposure" in found for found in learned.values())
    # random points say nothing of where things are
    known = _RANDOM not in capture.source
    near = are_floaters(params["means"], capture, config.test_every) if known else torch.zeros(0, dtype=torch.bool)
    cleared = {name: tensor[~near] for name, tensor in params.items()} if near.any() else {}
    without = [(view, looked(view, cleared).image) for view in test] if cleared else []
    checks = Checks(
        photographs=len(train),
        train_psnr=float(np.mean([_psnr(view, fitted[view.name]) for view in some])),
        train_measured=len(some),
        held_out_psnr=_mean(list(held_out.values())),
        held_out=matched if exposures else held_out,
        matched_psnr=_mean(list(matched.values())),
        neighbour_degrees=neighbour_degrees(np.stack([view.viewmat for view in train])),
        stops={view.name: stops_between(*_kept(view, seen[view.name].image)) for view in (*some, *test)},
        floaters=_floaters(capture, test or some, params, looked) if known else {},
        orbit_floaters=_floaters(capture, turn, params, looked) if known else {},
        without_floaters=_mean([_psnr(view, _matched(view, im) if exposures else im) for view, im in without]),
        misfits={view.name: misfit_share(view, fitted[view.name]) for view in some},
        patches={view.name: patch_share(view, fitted[view.name]) for view in some},
        steps=step + 1,
        exposures_learned=exposures,
        given=len(capture.views) + capture.unplaced,
        placed=len(capture.views),
    )
    write_json(folder / "report_data" / f"checks_step{step}.json", asdict(checks))
    with VideoFile(folder / "videos" / f"orbit_step{step}.webm", _ORBIT_FPS) as video:
        for view in turn:
            video.add(to_uint8(looked(view).image))
    return checks


def _keep_picture(results: ResultFolder, stem: str, view: View, layers: Layers) -> None:
    """Write what the report shows of a view that measurements kept no pictures of."""
    tensors = ViewTensors.of(view)
    found = measure(torch.from_numpy(layers.image), tensors.target(), tensors.mask)
    render = to_uint8(layers.image)
    results.write_arrays(stem, name=view.name, render=render, photo=view.image, psnr=found.psnr, ssim=found.ssim)


def near_limit(view: View, points: np.ndarray) -> float | None:
    """Give the camera z up to which nothing was photographed: half that of the nearest points in the picture.

    None where too few of the points [P, 3] are in the picture to tell.
    """
    # a row of numbers for each axis: of hundreds of views and as many thousand points, that takes a fifth of the time
    seen = view.viewmat[:3, :3] @ points.T + view.viewmat[:3, 3:]
    columns, rows, depths = view.K @ seen
    before = seen[2] > 1e-6
    inside = before & (columns >= 0.0) & (columns < view.width * depths)
    inside &= (rows >= 0.0) & (rows < view.height * depths)
    if inside.sum() < _FEWEST_POINTS:
        return None
    return _NEAR * float(np.quantile(seen[2][inside], _NEAREST_POINTS))


def nearer_than(params: Mapping[str, Tensor], view: View, limit: float) -> dict[str, Tensor]:
    """Select the Gaussians whose centres lie before a camera and nearer than a limit, world units."""
    chosen = _are_nearer(params["means"], view, limit)
    return {name: tensor.detach()[chosen] for name, tensor in params.items()}


def _are_nearer(means: Tensor, view: View, limit: float) -> Tensor:
    axis = torch.from_numpy(view.viewmat[2]).to(means)
    depths = means.detach() @ axis[:3] + axis[3]
    return (depths > 0.0) & (depths < limit)


def are_floaters(means: Tensor, capture: Capture, test_every: int) -> Tensor:
    """Tell which centres [N, 3] stand in the picture of a photograph's or the orbit's camera too near to it. bool [N]

    What reaches into such a picture from outside of it stays: of that, much is seen well by other photographs. Held-out
    cameras look too. Random points say nothing of where things are, and a PopError says so.
    """
    if _RANDOM in capture.source:
        raise PopError(f"{capture.name}: has no sparse points of its own, which are needed to find floaters")
    centers, found = means.detach().cpu().double(), torch.zeros(len(means), dtype=torch.bool)
    for view in (*capture.views, *orbit_views(capture.train_views(test_every))):
        limit = near_limit(view, capture.points)
        if limit is None:
            continue
        near = torch.nonzero(_are_nearer(centers, view, limit)).flatten()
        viewmat, K = (torch.from_numpy(matrix).double() for matrix in (view.viewmat, view.K))
        pixels = (centers[near] @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
        inside = (pixels[:, :2] >= 0.0) & (pixels[:, :2] < torch.tensor([view.width, view.height]) * pixels[:, 2:])
        found[near[inside.all(1)]] = True
    return found


def are_veils(
    params: Mapping[str, Tensor], capture: Capture, config: TrainConfig, sh_degree: int, backend: Any
) -> Tensor:
    """Tell which Gaussians hide more of the orbit's views than they show of the photographs, wherever they stand.

    In a view of the orbit counts what stands nearer than floaters do, also what reaches into it from outside of it; in
    a training view what does not. Each is a share of the pixels, by blending weights, on average. What stands behind
    takes nothing off these weights, so that a view of the orbit is drawn without it. A training view is drawn whole,
    and of more than 40 such views 40 are, evenly spread over the capture. bool [N]
    """
    train = capture.train_views(config.test_every)
    hidden, shown = (torch.zeros(len(params["means"]), dtype=torch.float64) for _ in range(2))

    def weights(view: View, chosen: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        found = Passes.of(backend, [ViewTensors.of(view)], config).contributions(chosen, 0, sh_degree)
        return found.weight_sum.cpu() / (view.width * view.height), found.depths.cpu()

    orbit = orbit_views(train)
    for view in orbit:
        limit = near_limit(view, capture.points)
        near = None if limit is None else _are_nearer(params["means"], view, limit)
        if near is not None and near.any():
            hidden[near] += weights(view, {name: tensor[near] for name, tensor in params.items()})[0] / len(orbit)
    if not (hidden > _HAZE).any():
        return hidden > _HAZE
    some = evenly(train, _MOST_WEIGHED)
    for view in some:
        limit = near_limit(view, capture.points)
        if limit is not None:
            share, depths = weights(view, params)
            shown += torch.where(depths < limit, 0.0, share) / len(some)
    return (hidden > _HAZE) & (hidden > shown)


def stops_between(photo: np.ndarray, render: np.ndarray) -> float:
    """Tell how much brighter a photograph is than a render, in stops: the median over pixels that are neither very dark
    nor nearly white; 0 where there are none. Both are in [0, 1]. [P, 3]
    """
    theirs, ours = photo.mean(axis=1), render.mean(axis=1)
    telling = (np.minimum(ours, theirs) > _DARK) & (np.maximum(ours, theirs) < 1.0 - _DARK)
    return float(GAMMA * np.median(np.log2(theirs[telling] / ours[telling]))) if telling.any() else 0.0


def misfit_share(view: View, render: np.ndarray) -> float:
    """Tell which share of a photograph is far from its render while most of it is near: what moved, or mirrors.

    Blocks whose mean error is six times the median block's and 0.06 or more, of all blocks; what a mask leaves out does
    not count.
    """
    error = np.abs(render - view.image[..., :3] / np.float32(255.0)).mean(axis=2)
    return _far_off(_means(error[..., None], view, _BLOCKS)[:, 0])


def patch_share(view: View, render: np.ndarray) -> float:
    """Tell which share of a photograph has another mean colour than its render while most of it has the same.

    Patches whose means differ by six times the median patch's and 0.06 or more, averaged over channels, once the median
    difference of all patches is taken off, as of another exposure; 0 where the median patch differs by over 0.01.
    """
    means = _means(render - view.image[..., :3] / np.float32(255.0), view, _PATCHES)
    differences = np.abs(means - np.median(means, axis=0)).mean(axis=1) if len(means) else means[:, 0]
    return _far_off(differences) if len(means) and np.median(differences) <= _LEARNED else 0.0


def _far_off(errors: np.ndarray) -> float:
    return float((errors > max(_TIMES_THE_REST * float(np.median(errors)), _FAR_OFF)).mean()) if len(errors) else 0.0


def _means(values: np.ndarray, view: View, across: int) -> np.ndarray:
    """Give the means of values [H, W, C] over what the mask keeps of each square block, where it keeps some. [B, C]"""
    kept = np.ones(values.shape[:2], values.dtype) if view.mask is None else view.mask.astype(values.dtype)
    side = max(1, max(kept.shape) // across)
    rows, columns = (size // side for size in kept.shape)

    def sums(of: np.ndarray) -> np.ndarray:
        return of[: rows * side, : columns * side].reshape(rows, side, columns, side, -1).sum(axis=(1, 3))

    pixels = sums(kept)
    return (sums(values * kept[..., None]) / np.maximum(pixels, 1.0))[pixels[..., 0] > 0.0]


def _floaters(capture: Capture, views: Sequence[View], params: Mapping[str, Tensor], looked: Any) -> dict[str, float]:
    shares: dict[str, float] = {}
    for view in views:
        limit = near_limit(view, capture.points)
        if limit is None:
            continue
        near = nearer_than(params, view, limit)
        shares[view.name] = float((looked(view, near).alpha >= _SEEN).mean()) if len(near["means"]) else 0.0
    return shares


def _from_learned(view: View, learned: Mapping[str, Any]) -> View:
    """Return a view with the camera that the run corrected, where it did."""
    viewmat = learned.get(view.name, {}).get("viewmat")
    return view if viewmat is None else replace(view, viewmat=np.array(viewmat))


def _exposed(image: np.ndarray, view: View, learned: Mapping[str, Any]) -> np.ndarray:
    """Return the render of a view in the colours of its photograph, where the run learned its exposure."""
    exposure = learned.get(view.name, {}).get("exposure")
    return image if exposure is None else expose(torch.from_numpy(image), torch.tensor(exposure)).numpy()


def _psnr(view: View, image: np.ndarray) -> float:
    tensors = ViewTensors.of(view)
    return min(psnr(torch.from_numpy(image), tensors.target(), tensors.mask), _MOST_PSNR)


def _kept(view: View, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the photograph's and the render's pixels where the mask keeps them, in [0, 1]. [P, 3] each"""
    mask = np.ones(view.image.shape[:2], bool) if view.mask is None else view.mask
    return view.image[mask] / np.float32(255.0), image[mask]


def _matched(view: View, image: np.ndarray) -> np.ndarray:
    theirs, ours = _kept(view, image)
    return image * ((ours * theirs).sum(0) / np.maximum((ours * ours).sum(0), 1e-12))


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def orbit_views(train: Sequence[View]) -> list[View]:
    """Make the cameras of the orbit, as large as fits the report; a PopError refuses to do it without a view."""
    if not train:
        raise PopError("every view is held out, and the orbit follows the others; hold fewer out with --test-every 8")
    lens = train[0]
    scale = min(1.0, _ORBIT_SIDE / max(lens.width, lens.height))
    width, height = (max(2, 2 * round(scale * side / 2)) for side in (lens.width, lens.height))
    K = np.diag([width / lens.width, height / lens.height, 1.0]) @ lens.K
    blank = np.zeros((height, width, 3), np.uint8)
    path = camera_path("orbit", np.stack([view.viewmat for view in train]), _ORBIT_FRAMES)
    return [View(f"frame {i} of the orbit", blank, viewmat, K) for i, viewmat in enumerate(path)]


def read_checks(path: Path) -> Checks:
    """Read checks_step{step}.json; a PopError names the entry that is damaged."""
    entry = read_json(path, _FIX)
    by_view = {"held_out", "stops", "floaters", "orbit_floaters", "misfits", "patches"}
    for name, value in entry.items():
        if name in by_view:
            right = isinstance(value, dict) and all(_is_number(number) for number in value.values())
        elif name == "exposures_learned":
            right = isinstance(value, bool)
        else:
            right = _is_number(value) or (value is None and name not in ("photographs", "train_psnr", "train_measured"))
        if not right:
            raise PopError(f"{path}: {name} is not what a run writes; {_FIX}")
    try:
        return Checks(**entry)
    except TypeError as error:
        raise PopError(f"{path}: is not what a run writes ({error}); {_FIX}") from error


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e150
