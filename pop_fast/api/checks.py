"""Checks of what `rasterization` is given: every wrong input is named, with its index, before anything is drawn.

Shapes, types and places are read at once. What only values can tell is asked in a pass or two over each tensor, and of
a GPU in two copies: the cameras, and what was made of everything else.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from numbers import Integral, Real
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from pop_fast.api.backend import Backend
from pop_ref.constants import GSPLAT_1_5, Profile, profile_named

Array = npt.NDArray[Any]

LARGEST_TILE: Final = 4096  # px; no image needs more, and what a tile works with grows with its square
RENDER_MODES: Final = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES: Final = ("classic", "antialiased")
_UNDISTORT: Final = "undistort the images first; `pop train` does it"
# the one value that each of gsplat's other arguments may have, and why
UNSUPPORTED: Final[Mapping[str, tuple[Any, str]]] = {
    "sparse_grad": (False, "gradients are dense"),
    "distributed": (False, "this is one process"),
    "camera_model": ("pinhole", _UNDISTORT),
    "segmented": (False, "there is one sort"),
    "with_ut": (False, "only the EWA projection is implemented"),
    "with_eval3d": (False, "splats are evaluated in screen space"),
    "radial_coeffs": (None, _UNDISTORT),
    "tangential_coeffs": (None, _UNDISTORT),
    "thin_prism_coeffs": (None, _UNDISTORT),
    "ftheta_coeffs": (None, _UNDISTORT),
    "rolling_shutter": (None, "only global shutters"),
    "viewmats_rs": (None, "only global shutters"),
}


def check_supported(given: Mapping[str, Any], backend: Backend) -> None:
    """Raise NotImplementedError for an argument that is not at the one value supported, by all backends or this one.

    Args:
        given: arguments by name, those of `UNSUPPORTED` and of `backend.lacks` among them.
    """
    for table, by in ((UNSUPPORTED, ""), (backend.lacks, f" by backend {backend.name!r}")):
        for name, (supported, why) in table.items():
            value = given[name]
            if value is not supported and (isinstance(value, Tensor) or value != supported):
                said = f"a tensor of shape {list(value.shape)}" if isinstance(value, Tensor) else repr(value)
                raise NotImplementedError(f"{name}={said} is not supported{by}: {why}")


def check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    """Raise ValueError, which names the argument, for a value that is not one of several."""
    if value not in choices:
        raise ValueError(f"{name} is {value!r}; it must be one of {', '.join(choices)}")


def resolved_profile(profile: str | Profile, near_plane: float, far_plane: float, eps2d: float) -> Profile:
    """Return the profile with the caller's near plane, far plane and low-pass where they differ from gsplat's.

    Raises:
        ValueError: no such profile, or a number with which nothing can be drawn; names it.
    """
    if not isinstance(profile, (str, Profile)):
        raise ValueError(f"profile is {profile!r}; it must be a name or a pop_ref.constants.Profile")
    chosen = profile_named(profile) if isinstance(profile, str) else profile
    given = {"near_plane": near_plane, "far_plane": far_plane, "eps2d": eps2d}
    changed = {name: value for name, value in given.items() if value != getattr(GSPLAT_1_5, name)}
    made = replace(chosen, **changed) if changed else chosen
    _check_profile(made)
    return made


def _check_profile(profile: Profile) -> None:
    for field in fields(profile):
        value = getattr(profile, field.name)
        if field.name != "name" and isinstance(value, (int, float)) and math.isnan(value):
            raise ValueError(f"{field.name} is {value}; it must be a number")
    p = profile
    # a point on an inclusive near plane at 0 would be divided by its depth
    rules = (
        ("near_plane", 0.0 <= p.near_plane < math.inf, "finite and >= 0"),
        ("far_plane", p.far_plane > p.near_plane, f"beyond near_plane, which is {p.near_plane}"),
        ("eps2d", 0.0 <= p.eps2d < math.inf, "finite and >= 0 px^2"),
        ("frustum_margin", p.frustum_margin >= 0.0, ">= 0"),
        ("extent_sigmas", 0.0 < p.extent_sigmas < math.inf, "finite and > 0"),
        ("alpha_floor", 0.0 < p.alpha_floor < 1.0, "in (0, 1)"),
        ("alpha_ceiling", p.alpha_floor < p.alpha_ceiling < 1.0, "between alpha_floor and 1"),
        ("transmittance_stop", 0.0 <= p.transmittance_stop < 1.0, "in [0, 1)"),
        ("tile_size", p.tile_size >= 1, ">= 1"),
    )
    for name, holds, rule in rules:
        if not holds:
            raise ValueError(f"{name} is {getattr(p, name)}; it must be {rule}")


@dataclass(frozen=True)
class _Rule:
    """A rule of a tensor's values."""

    name: str  # of the tensor
    tensor: Tensor | Array  # it, or an array of it that came from a GPU
    probe: Callable[[], Sequence[Any]]  # a few numbers of it, each made in a pass or two: a tensor's or an array's
    # whether these numbers leave room for a bad entry; only then it is looked at closely
    suspicious: Callable[..., bool]
    bad: Callable[[], Tensor | Array]  # which entries or rows are
    words: str  # what it must be


class Checks:
    """The checks of one call; what is wrong raises ValueError, which names the tensor or the argument.

    Args:
        backend: which says where tensors must lie, and of which type.
        dtype: of the means, that all others must have.
    """

    def __init__(self, backend: Backend, dtype: torch.dtype) -> None:
        self._backend, self._dtype = backend, dtype
        self._rules: list[_Rule] = []

    def tensor(self, name: str, tensor: Any, shape: tuple[int, ...]) -> Tensor:
        """Check one tensor's presence, place, type and shape, and return it; that it is finite is asked in `values`."""
        check_given(**{name: tensor})
        if not self._backend.holds(tensor):
            # the backend's own device by the name of the method that moves a tensor there
            device = self._backend.device
            raise ValueError(
                f"{name} is on {tensor.device}; backend {self._backend.name!r} reads {device}: use {name}.{device}()"
            )
        allowed = self._backend.dtypes
        if str(tensor.dtype).removeprefix("torch.") not in allowed or tensor.dtype != self._dtype:
            rule = f"be {allowed[0]} for backend {self._backend.name!r}" if len(allowed) == 1 else "have one type, "
            rule += "" if len(allowed) == 1 else " or ".join(allowed)
            raise ValueError(f"{name} has dtype {tensor.dtype}; all tensors must {rule}")
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} has shape {list(tensor.shape)}; it must be {list(shape)}")
        return tensor

    def finite(self, name: str, tensor: Tensor) -> Tensor:
        """Ask in `values` that a tensor is finite, and return it without its gradient."""
        t = tensor.detach()

        def infinite(total: float) -> bool:
            return not math.isfinite(total)

        # a sum is one fast pass
        self._rule(name, t, lambda: (t.sum(),), infinite, lambda: ~torch.isfinite(t), "must be finite")
        return t

    def gaussians(
        self,
        means: Tensor,
        quats: Tensor | None,
        scales: Tensor | None,
        opacities: Tensor,
        covars: Tensor | None,
    ) -> tuple[int, ...]:
        """Check the Gaussians' tensors, and return the batch dimensions."""
        if means.dim() < 2 or means.shape[-1] != 3:
            raise ValueError(f"means has shape {list(means.shape)}; it must be [..., N, 3]")
        batch, n = tuple(means.shape[:-2]), means.shape[-2]
        if 0 in batch:
            raise ValueError(f"means has shape {list(means.shape)}; a batch must hold at least one scene")
        self.finite("means", self.tensor("means", means, tuple(means.shape)))
        o = self.finite("opacities", self.tensor("opacities", opacities, (*batch, n)))

        def outside(least: float, most: float) -> bool:
            return not (least >= 0.0 and most <= 1.0)

        bad = "must be in [0, 1]"
        self._rule("opacities", o, lambda: torch.aminmax(o), outside, lambda: ~((o >= 0.0) & (o <= 1.0)), bad)
        if covars is not None:
            self.finite("covars", self.tensor("covars", covars, (*batch, n, 3, 3)))
            return batch
        q = self.finite("quats", self.tensor("quats", quats, (*batch, n, 4)))

        def shortest() -> tuple[Tensor]:
            # of a tiny quaternion it may be rounded to 0, which is looked at closely
            return (torch.linalg.vector_norm(q, dim=-1).amin(),)

        self._rule(
            "quats", q, shortest, lambda least: least == 0.0, lambda: q.abs().amax(-1) == 0.0, "must have a norm > 0"
        )
        s = self.finite("scales", self.tensor("scales", scales, (*batch, n, 3)))
        words = "must be >= 0; give standard deviations, not logarithms"
        self._rule("scales", s, lambda: (s.amin(),), lambda least: least < 0.0, lambda: s < 0.0, words)
        return batch

    def cameras(
        self, viewmats: Tensor, Ks: Tensor, width: int, height: int, tile_size: int, batch: tuple[int, ...]
    ) -> int:
        """Check the cameras' tensors and sizes, and return how many there are."""
        if viewmats.dim() < 3:
            raise ValueError(f"viewmats has shape {list(viewmats.shape)}; it must be [..., C, 4, 4]")
        n = viewmats.shape[-3]
        if n == 0:
            raise ValueError(f"viewmats has shape {list(viewmats.shape)}; there must be at least one camera")
        given = self.tensor("viewmats", viewmats, (*batch, n, 4, 4)), self.tensor("Ks", Ks, (*batch, n, 3, 3))
        check_sizes(width, height, tile_size)
        # a few numbers, of which every question is a launch on a GPU and some microseconds in torch
        V, K = _on_host(*given)
        for name, array in (("viewmats", V), ("Ks", K)):
            self._each(name, array, lambda array=array: ~np.isfinite(array), "must be finite")
        rows = "must be rigid: an orthonormal 3x3 rotation with determinant +1"
        self._each("viewmats", V, lambda: _not_rigid(V[..., :3, :3]), rows)
        last = (0.0, 0.0, 0.0, 1.0)
        self._each("viewmats", V, lambda: (V[..., 3, :] != last).any(-1), "must end in the row [0, 0, 0, 1]")
        positive = "must have focal lengths > 0"
        self._each("Ks", K, lambda: ~((K[..., 0, 0] > 0.0) & (K[..., 1, 1] > 0.0)), positive)
        pinhole = "must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; skew is not supported"
        self._each("Ks", K, lambda: _skewed(K), pinhole)
        return n

    def colors(self, colors: Tensor, sh_degree: int | None, batch: tuple[int, ...], n_cameras: int, n: int) -> bool:
        """Check the colours or coefficients, and tell whether they are given per camera."""
        tail = 1 if sh_degree is None else 2
        channels = tuple(colors.shape[max(colors.dim() - tail, 0) :])
        shared, per_camera = (*batch, n, *channels), (*batch, n_cameras, n, *channels)
        if sh_degree is not None:
            if not isinstance(sh_degree, Integral) or sh_degree not in (0, 1, 2, 3):
                raise ValueError(f"sh_degree is {sh_degree!r}; it must be None, 0, 1, 2 or 3")
            need = (sh_degree + 1) ** 2
            if len(channels) != 2 or channels[1] != 3 or channels[0] < need:
                raise ValueError(
                    f"colors has shape {list(colors.shape)}; sh_degree={sh_degree} needs [..., N, >={need}, 3]"
                )
        elif colors.dim() < len(batch) + 2:
            rows = ", ".join(map(str, (*batch, n)))
            raise ValueError(f"colors has shape {list(colors.shape)}; it must be [{rows}, D]")
        is_per_camera = tuple(colors.shape) == per_camera
        self.finite("colors", self.tensor("colors", colors, per_camera if is_per_camera else shared))
        return is_per_camera

    def values(self) -> None:
        """Check what was left to be asked of values, in one go."""
        probes = [rule.probe() for rule in self._rules]
        # what is on a GPU comes in one copy
        there = [number for numbers in probes for number in numbers if _is_elsewhere(number)]
        read = iter(torch.stack(there).tolist() if there else ())
        for numbers, rule in zip(probes, self._rules, strict=True):
            here = [next(read) if _is_elsewhere(number) else number.item() for number in numbers]
            found = torch.as_tensor(rule.bad()).nonzero() if rule.suspicious(*here) else None
            if found is not None and len(found):
                index = found[0].tolist()
                raise ValueError(f"{rule.name}{index} is {rule.tensor[tuple(index)].tolist()}; it {rule.words}")

    def _each(self, name: str, array: Array, bad: Callable[[], Array], words: str) -> None:
        self._rule(name, array, lambda: (bad().any(),), bool, bad, words)

    def _rule(self, name: str, tensor: Tensor | Array, *rest: Any) -> None:
        if 0 not in tensor.shape:
            self._rules.append(_Rule(name, tensor, *rest))


def check_given(**tensors: Any) -> None:
    """Raise ValueError, which names the argument, for what must be given and is no tensor."""
    for name, value in tensors.items():
        if not isinstance(value, Tensor):
            problem = "is missing" if value is None else f"is of type {type(value).__name__}"
            raise ValueError(f"{name} {problem}; it must be a torch.Tensor")


def check_numbers(**numbers: Any) -> None:
    """Raise ValueError, which names the argument, for what must be a number and is none."""
    for name, value in numbers.items():
        if not isinstance(value, Real):
            raise ValueError(f"{name} is {value!r}; it must be a number")


def check_sizes(width: int, height: int, tile_size: int) -> None:
    """Raise ValueError, which names the size, for an image or a tile that is none."""
    for name, value in {"width": width, "height": height, "tile_size": tile_size}.items():
        if not isinstance(value, Integral) or isinstance(value, bool) or value < 1:
            raise ValueError(f"{name} is {value!r}; it must be a whole number >= 1")
    if tile_size > LARGEST_TILE:
        raise ValueError(f"tile_size is {tile_size}; it must be <= {LARGEST_TILE}")


def _is_elsewhere(number: Any) -> bool:
    return isinstance(number, Tensor) and number.device.type != "cpu"


def _on_host(*tensors: Tensor) -> list[Array]:
    """Return small tensors of one device and type as arrays, in one copy."""
    own = [tensor.detach() for tensor in tensors]
    if own[0].device.type == "cpu":
        return [tensor.numpy() for tensor in own]
    joined = torch.cat([tensor.reshape(-1) for tensor in own]).cpu().numpy()
    parts = np.split(joined, np.cumsum([tensor.numel() for tensor in own])[:-1])
    return [part.reshape(tensor.shape) for part, tensor in zip(parts, own, strict=True)]


def _not_rigid(rotations: Array) -> Array:
    R = rotations.astype(np.float64)
    # of what is not finite, which has its own rule
    with np.errstate(all="ignore"):
        off = np.abs(R @ R.swapaxes(-1, -2) - np.eye(3)).max((-1, -2))
        return ~((off < 1e-3) & (np.linalg.det(R) > 0.0))


def _skewed(K: Array) -> Array:
    return (K[..., 0, 1] != 0.0) | (K[..., 1, 0] != 0.0) | (K[..., 2, :2] != 0.0).any(-1) | (K[..., 2, 2] != 1.0)
