"""Captures as a row sees them, in one file: photographs undistorted and shrunk, cameras and points.

A node for GPU work may lack what undistorts photographs, and a whole capture may be too large to travel. What is
written here is byte for byte what `load_capture` gives, so that a row trained from it has the same data hash as one
that was trained from the photographs. `benchmarks/gpu_pack.py --prepared SCENE` writes the files; where the folder of a
scene holds one of the row's factor, the row is trained from it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from pop_fast.errors import PopError
from pop_fast.io.atomic import write_atomically

if TYPE_CHECKING:
    from pop_fast.data import Capture, View
    from pop_fast.train import TrainConfig

_FIX: Final = "pack it again with benchmarks/gpu_pack.py --prepared"
_FORMS: Final = {
    # what is no number, as JSON in UTF-8: numpy's own texts may hold what is none
    "said": ("u", 1),
    "sizes": ("i", 2),
    "residuals": ("u", 1),
    "viewmats": ("f", 3),
    "Ks": ("f", 3),
    "points": ("f", 2),
    "points_rgb": ("u", 2),
    "world_transform": ("f", 2),
    "masked": ("b", 1),
    "masks?": ("b", 1),
    "tracks": ("i", 1),
    "seen?": ("i", 1),
}
# of a config, what a capture that is loaded depends on
_OPTIONS: Final = ("factor", "normalize", "background", "resize")


def path_of(folder: Path, config: TrainConfig) -> Path:
    """Return where a scene's folder has what was prepared for a config."""
    return folder / f"prepared_{config.factor}.npz"


def write(capture: Capture, config: TrainConfig, folder: Path) -> Path:
    """Write a capture that was loaded for a config.

    Raises:
        PopError: it has transparency, which rows of the tables do not know.
    """
    views = capture.views
    if any(view.alpha is not None or not view.was_read for view in views):
        raise PopError(f"{capture.name}: has photographs with transparency, or that were not read")
    tracks = np.array([-1 if view.seen is None else len(view.seen) for view in views], np.int32)
    said = {"options": _options(config), "name": capture.name, "source": capture.source, "notes": capture.notes}
    said |= {"names": [view.name for view in views], "splits": [view.split or "" for view in views]}
    arrays: dict[str, Any] = {
        "said": np.frombuffer(json.dumps(said).encode(), np.uint8),
        "sizes": np.array([(view.width, view.height) for view in views], np.int32),
        "residuals": np.concatenate([_residuals(view.image).reshape(-1) for view in views]),
        "viewmats": np.stack([view.viewmat for view in views]),
        "Ks": np.stack([view.K for view in views]),
        "points": capture.points,
        "points_rgb": capture.points_rgb,
        "world_transform": capture.world_transform,
        "masked": np.array([view.mask is not None for view in views]),
        "tracks": tracks,
    }
    masks = [view.mask.reshape(-1) for view in views if view.mask is not None]
    seen = [view.seen for view in views if view.seen is not None and len(view.seen)]
    arrays |= {"masks": np.concatenate(masks)} if masks else {}
    arrays |= {"seen": np.concatenate(seen).astype(np.int32)} if seen else {}
    path = path_of(folder, config)
    write_atomically(path, lambda file: np.savez_compressed(file, **arrays))
    return path


def read(path: Path, config: TrainConfig) -> Capture:
    """Read what was prepared for a config.

    Raises:
        PopError: the file is damaged, or was prepared for other settings; names it.
    """
    from pop_fast.data import Capture
    from pop_fast.io.read_back import read_arrays

    arrays = read_arrays(path, _FORMS, _FIX)
    said = _said(path, arrays["said"])
    if said["options"] != _options(config):
        raise PopError(f"{path}: was prepared for {said['options']}, and the row asks for {_options(config)}; {_FIX}")
    _check(path, arrays, said)
    return Capture(
        said["name"],
        tuple(_views(arrays, said)),
        arrays["points"],
        arrays["points_rgb"],
        said["source"],
        arrays["world_transform"],
        tuple(said["notes"]),
    )


def _options(config: TrainConfig) -> dict[str, Any]:
    # as JSON gives them back
    return json.loads(json.dumps({name: getattr(config, name) for name in _OPTIONS}))


def _said(path: Path, stored: np.ndarray) -> dict[str, Any]:
    try:
        said = json.loads(stored.tobytes().decode())
        texts = [said["name"], said["source"], *said["notes"], *said["names"], *said["splits"]]
        if not isinstance(said["options"], dict) or not all(isinstance(text, str) for text in texts):
            raise ValueError("options, or one of the texts, are of another type")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise PopError(f"{path}: said cannot be read ({error!r}); {_FIX}") from error
    return said


def _check(path: Path, arrays: dict[str, np.ndarray], said: dict[str, Any]) -> None:
    """Hold the arrays' sizes to each other.

    Raises:
        PopError: names the one that does not fit.
    """
    n, sizes = len(said["names"]), arrays["sizes"].astype(np.int64)
    pixels = sizes.prod(1) if sizes.shape == (n, 2) and (sizes > 0).all() else np.zeros(0, np.int64)
    tracks, none = arrays["tracks"].astype(np.int64), np.zeros(0, np.int64)
    seen, n_points = arrays.get("seen", none), len(arrays["points"])
    masked = pixels[arrays["masked"]].sum() if len(pixels) == len(arrays["masked"]) else -1
    finite = all(np.isfinite(arrays[name]).all() for name in ("viewmats", "Ks", "points", "world_transform"))
    fits = {
        "sizes": len(pixels) == n,
        "names": len(set(said["names"])) == n,
        "splits": len(said["splits"]) == n and set(said["splits"]) <= {"", "train", "val", "test"},
        "residuals": arrays["residuals"].dtype == np.uint8 and arrays["residuals"].size == 3 * pixels.sum(),
        "viewmats": arrays["viewmats"].shape == (n, 4, 4) and arrays["viewmats"].dtype == np.float64,
        "Ks": arrays["Ks"].shape == (n, 3, 3) and arrays["Ks"].dtype == np.float64,
        "points": arrays["points"].shape == (n_points, 3) and arrays["points"].dtype == np.float64 and finite,
        "points_rgb": arrays["points_rgb"].shape == (n_points, 3) and arrays["points_rgb"].dtype == np.uint8,
        "world_transform": arrays["world_transform"].shape == (4, 4),
        "masks": arrays.get("masks", none).size == masked,
        "tracks": tracks.shape == (n,) and seen.size == tracks.clip(0).sum(),
        "seen": seen.size == 0 or (seen.min() >= 0 and seen.max() < n_points),
    }
    bad = [name for name, holds in fits.items() if not holds]
    if bad:
        raise PopError(f"{path}: {', '.join(bad)} do not fit the {n} photographs; {_FIX}")


def _residuals(image: np.ndarray) -> np.ndarray:
    """Return an (H, W, 3) uint8 image without what its green, left and upper neighbours foretell, modulo 256.

    Deflated, three captures of the tables took 62 % of the bytes that their pixels took.
    """
    found = image.copy()
    found[..., ::2] -= image[..., 1:2]
    for axis in (0, 1):
        found = np.diff(found, axis=axis, prepend=np.zeros_like(found.take([0], axis)))
    return found


def _image(residuals: np.ndarray) -> np.ndarray:
    """Return the image whose residuals these are."""
    found = residuals.cumsum(0, np.uint8).cumsum(1, np.uint8)
    found[..., ::2] += found[..., 1:2]
    return found


def _views(arrays: dict[str, np.ndarray], said: dict[str, Any]) -> list[View]:
    from pop_fast.data import View

    found: list[View] = []
    pixel = mask = track = 0
    for k, (width, height) in enumerate(arrays["sizes"].astype(np.int64).tolist()):
        size, n_seen = width * height, int(arrays["tracks"][k])
        image = _image(arrays["residuals"][pixel : pixel + 3 * size].reshape(height, width, 3))
        pixel += 3 * size
        own_mask = own_seen = None
        if arrays["masked"][k]:
            own_mask = arrays["masks"][mask : mask + size].reshape(height, width)
            mask += size
        if n_seen >= 0:
            own_seen = arrays["seen"][track : track + n_seen] if n_seen else np.zeros(0, np.int32)
            track += n_seen
        split = said["splits"][k] or None
        cameras = arrays["viewmats"][k], arrays["Ks"][k]
        found.append(View(said["names"][k], image, *cameras, own_mask, split, seen=own_seen))
    return found
