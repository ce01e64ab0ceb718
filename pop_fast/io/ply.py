"""Read and write splats in the PLY layout of the 3DGS reference code, which every viewer opens.

One row a Gaussian, little-endian float32: x y z, nx ny nz (zeros), f_dc_0..2, f_rest_0..44, opacity, scale_0..2,
rot_0..3. Opacities are logits, scales logarithms, rotations wxyz of any norm; f_rest is channel-major: fifteen
coefficients of red, then green, then blue. A header comment `SplatRenderMode: mip` marks antialiased splats, and one
`pop-frame:` says which world they are in.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch

from pop_fast.errors import PopError
from pop_fast.io.atomic import write_atomically
from pop_fast.io.frame import Frame
from pop_fast.io.ply_rows import Header, column, read_header, read_vertices, vertices_of

__all__ = [
    "MODE",
    "Frame",
    "asks_for_antialiasing",
    "checked_params",
    "frame_of",
    "is_antialiased",
    "load_ply",
    "params_of_ply",
    "ply_bytes",
    "save_ply",
]

_SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3)}
MODE = "SplatRenderMode:"
# sigmoid(logit) >= 1/255, what a renderer can show at all
_VISIBLE_LOGIT = -np.log(254.0)
_COLUMNS = (
    ["x", "y", "z", "nx", "ny", "nz"]
    + [f"f_dc_{i}" for i in range(3)]
    + [f"f_rest_{i}" for i in range(45)]
    + ["opacity"]
    + [f"scale_{i}" for i in range(3)]
    + [f"rot_{i}" for i in range(4)]
)


def save_ply(
    path: str | os.PathLike[str],
    params: dict[str, torch.Tensor],
    antialiased: bool = False,
    drop_transparent: bool = False,
    frame: Frame | None = None,
) -> tuple[int, int]:
    """Write raw parameters as PLY, atomically.

    Args:
        path: the file to write.
        params: means [N, 3], scales [N, 3], quats [N, 4], opacities [N], sh0 [N, 1, 3], shN [N, 0|3|8|15, 3], raw.
        antialiased: the splats were trained with antialiasing, and are to be drawn so.
        drop_transparent: leave out Gaussians with an opacity under 1/255, which no renderer shows.
        frame: the world that they are in, where it is known; written as a comment.

    Returns:
        The number of Gaussians before and after that filter.

    Raises:
        PopError: a parameter is absent, of the wrong shape, NaN or Inf; or the file cannot be written.
    """
    arrays = checked_params(params)
    before = len(arrays["means"])
    if drop_transparent:
        visible = arrays["opacities"] >= _VISIBLE_LOGIT
        arrays = {name: array[visible] for name, array in arrays.items()}
    write_atomically(path, lambda file: file.write(_file(arrays, antialiased, frame)))
    return before, len(arrays["means"])


def ply_bytes(params: dict[str, torch.Tensor], antialiased: bool = False, frame: Frame | None = None) -> bytes:
    """Return what `save_ply` writes.

    Raises:
        PopError: a parameter is absent, of the wrong shape, NaN or Inf.
    """
    return _file(checked_params(params), antialiased, frame)


def _file(arrays: dict[str, np.ndarray], antialiased: bool, frame: Frame | None) -> bytes:
    n = len(arrays["means"])
    rest = np.zeros((n, 15, 3), np.float32)
    rest[:, : arrays["shN"].shape[1]] = arrays["shN"]
    columns = [
        arrays["means"],
        np.zeros((n, 3), np.float32),
        arrays["sh0"].reshape(n, 3),
        rest.transpose(0, 2, 1).reshape(n, 45),
        arrays["opacities"][:, None],
        arrays["scales"],
        arrays["quats"],
    ]
    table = np.ascontiguousarray(np.concatenate(columns, axis=1), dtype="<f4")
    return _header(n, antialiased, frame) + table.tobytes()


def _header(n: int, antialiased: bool, frame: Frame | None) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"comment {MODE} {'mip' if antialiased else 'default'}"]
    if frame is not None:
        lines.append(f"comment {frame.comment()}")
    lines += [f"element vertex {n}", *(f"property float {name}" for name in _COLUMNS), "end_header", ""]
    return "\n".join(lines).encode("ascii")


def load_ply(path: str | os.PathLike[str]) -> dict[str, torch.Tensor]:
    """Read splats from a PLY file: columns by name, in any order, among any others.

    Normals are ignored; f_rest may be absent or of a lower degree (0, 9, 24 or 45 columns) and is padded with zeros.

    Returns:
        means [N, 3], scales [N, 3], quats [N, 4], opacities [N], sh0 [N, 1, 3], shN [N, 15, 3]; raw, float32.

    Raises:
        PopError: the file is absent, truncated or corrupt, is no splat, or holds NaN, Inf or a zero quaternion.
    """
    path = Path(path)
    return _params(read_vertices(path), path)


def params_of_ply(data: bytes, path: Path) -> dict[str, torch.Tensor]:
    """Read splats from a PLY file's bytes; see `load_ply`.

    Args:
        data: the bytes.
        path: their name, for errors.

    Raises:
        PopError: as `load_ply`.
    """
    return _params(vertices_of(data, path), path)


def _params(rows: np.ndarray, path: Path) -> dict[str, torch.Tensor]:
    names = set(rows.dtype.names or ())
    needed = [c for c in _COLUMNS if not c.startswith(("n", "f_rest"))]
    absent = [name for name in needed if name not in names]
    if absent:
        raise PopError(f"{path}: vertex has no property {absent[0]!r}; it is not a splat as 3DGS writes it")
    count = sum(name.startswith("f_rest_") for name in names)
    if count not in (0, 9, 24, 45) or any(f"f_rest_{i}" not in names for i in range(count)):
        raise PopError(f"{path}: vertex has {count} f_rest properties; there must be 0, 9, 24 or 45, without a gap")

    def columns(*wanted: str) -> np.ndarray:
        stacked = np.stack([column(path, rows, name, np.float32) for name in wanted], axis=1)
        bad = np.argwhere(~np.isfinite(stacked))
        if len(bad):
            row, which = (int(i) for i in bad[0])
            raise PopError(f"{path}: vertex[{row}].{wanted[which]} is {stacked[row, which]}; it must be finite")
        return stacked

    n = len(rows)
    rest = np.zeros((n, 15, 3), np.float32)
    if count:
        rest[:, : count // 3] = (
            columns(*(f"f_rest_{i}" for i in range(count))).reshape(n, 3, count // 3).transpose(0, 2, 1)
        )
    quats = columns(*(f"rot_{i}" for i in range(4)))
    if n and not quats.any(axis=1).all():
        row = int(np.argmin(quats.any(axis=1)))
        raise PopError(f"{path}: vertex[{row}].rot is a zero quaternion; write [1, 0, 0, 0] for no rotation")
    arrays = {
        "means": columns("x", "y", "z"),
        "scales": columns(*(f"scale_{i}" for i in range(3))),
        "quats": quats,
        "opacities": columns("opacity")[:, 0],
        "sh0": columns(*(f"f_dc_{i}" for i in range(3)))[:, None, :],
        "shN": rest,
    }
    return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()}


def is_antialiased(path: str | os.PathLike[str]) -> bool:
    """Tell whether a PLY file asks to be drawn with antialiasing: its comment `SplatRenderMode: mip`."""
    return asks_for_antialiasing(read_header(Path(path)))


def asks_for_antialiasing(header: Header) -> bool:
    """Tell whether a header has the comment `SplatRenderMode: mip`."""
    return any(comment.startswith(MODE) and comment.split()[-1] == "mip" for comment in header.comments)


def frame_of(path: str | os.PathLike[str]) -> Frame | None:
    """Tell which world a PLY file's splats are in, by its comment; None where there is none, as of other programs.

    Raises:
        PopError: the comment is not one that this program writes.
    """
    return Frame.of_comments(read_header(Path(path)).comments, Path(path))


def checked_params(params: dict[str, torch.Tensor]) -> dict[str, np.ndarray]:
    """Return raw parameters as float32 arrays.

    Raises:
        PopError: one is absent, of the wrong shape, NaN or Inf, or a quaternion is zero; names the entry.
    """
    arrays: dict[str, np.ndarray] = {}
    for name in (*_SHAPES, "shN"):
        if name not in params:
            raise PopError(f"params has no {name!r}; a splat needs {', '.join(_SHAPES)} and shN")
        arrays[name] = params[name].detach().cpu().numpy().astype(np.float32, copy=False)
    n = len(arrays["means"])
    for name, array in arrays.items():
        bands = array.shape[1] if name == "shN" and array.ndim == 3 and array.shape[1] in (0, 3, 8, 15) else 15
        want = (n, *_SHAPES.get(name, (bands, 3)))
        if array.shape != want:
            raise PopError(f"{name} has shape {list(array.shape)}; it must be {list(want)}")
        bad = np.argwhere(~np.isfinite(array))
        if len(bad):
            index = tuple(int(i) for i in bad[0])
            raise PopError(f"{name}{list(index)} is {array[index]}; every parameter must be finite")
    norms = np.abs(arrays["quats"]).sum(axis=1)
    if n and norms.min() == 0.0:
        raise PopError(f"quats[{int(np.argmin(norms))}] is zero; every quaternion must have a norm > 0")
    return arrays
