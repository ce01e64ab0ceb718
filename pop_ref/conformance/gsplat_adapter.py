"""Adapters for gsplat 1.5: its CUDA rasterizer, and the stage functions in plain torch that its tests compare with.

gsplat's torch functions run on a CPU. They are its private reference, so their names may move between versions; the
adapter was written against 1.5.3. Their extents leave out the opacity, so culling is not judged; conics and the
antialiasing's factors are read from the fused projection of splats that a unit camera sees straight on.
"""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Callable
from typing import Any

from pop_ref.conformance.torch_adapter import TorchAdapter
from pop_ref.constants import GSPLAT_1_5, GSPLAT_1_6, Profile


def torch_stages() -> dict[str, Callable[..., Any]]:
    """Return gsplat's torch functions under the oracle's names, one camera, no batch."""
    impl: Any = importlib.import_module("gsplat.cuda._torch_impl")
    torch: Any = importlib.import_module("torch")
    return _world_stages(impl, torch) | _screen_stages(impl, torch)


def _world_stages(impl: Any, torch: Any) -> dict[str, Callable[..., Any]]:
    def covars_from_quats_scales(quats: Any, scales: Any) -> Any:
        return impl._quat_scale_to_covar_preci(quats, scales, compute_preci=False)[0]

    def sh_basis(dirs: Any, degree: int) -> Any:
        return impl._eval_sh_bases_fast((degree + 1) ** 2, dirs)

    def colors_from_sh(sh: Any, dirs: Any, degree: int) -> Any:
        # the offset and the clamp are rendering.py's
        return torch.clamp_min(impl._spherical_harmonics(degree, dirs, sh) + 0.5, 0.0)

    def means_cam_from_means(means: Any, viewmat: Any) -> Any:
        return impl._world_to_cam(means, _identities(means), viewmat[None])[0][0]

    def covars_cam_from_covars(covars: Any, viewmat: Any) -> Any:
        return impl._world_to_cam(covars[:, :, 0], covars, viewmat[None])[1][0]

    def project_means(means_cam: Any, K: Any, width: int, height: int, profile: Profile | None = None) -> Any:
        return impl._persp_proj(means_cam[None], _identities(means_cam)[None], K[None], width, height)[0][0]

    def _identities(means: Any) -> Any:
        return torch.eye(3, dtype=means.dtype, device=means.device).expand(len(means), 3, 3)

    return {
        "rotmats_from_quats": impl._quat_to_rotmat,
        "covars_from_quats_scales": covars_from_quats_scales,
        "sh_basis": sh_basis,
        "colors_from_sh": colors_from_sh,
        "means_cam_from_means": means_cam_from_means,
        "covars_cam_from_covars": covars_cam_from_covars,
        "project_means": project_means,
    }


def _screen_stages(impl: Any, torch: Any) -> dict[str, Callable[..., Any]]:
    def conics_from_covars2d(covars2d: Any) -> Any:
        return _seen_straight_on(covars2d, 0.0)[3][0]

    def compensations(covars2d: Any, eps2d: float) -> Any:
        return _seen_straight_on(covars2d, eps2d)[4][0]

    def _seen_straight_on(covars2d: Any, eps2d: float) -> Any:
        # at depth 1 on the axis of a camera of focal length 1 the Jacobian drops z and changes nothing else
        n, like = len(covars2d), {"dtype": covars2d.dtype, "device": covars2d.device}
        means = torch.tensor([[0.0, 0.0, 1.0]], **like).expand(n, 3)
        covars = torch.nn.functional.pad(covars2d, (0, 1, 0, 1))
        camera = (torch.eye(4, **like)[None], torch.eye(3, **like)[None], 2, 2)
        return impl._fully_fused_projection(means, covars, *camera, eps2d=eps2d, calc_compensations=True)

    def tile_lists(
        means2d: Any,
        radii: Any,
        depths: Any,
        width: int,
        height: int,
        tile_size: int,
        profile: Profile | None = None,
    ) -> Any:
        grid = (-(-width // tile_size), -(-height // tile_size))
        _, keys, ids = impl._isect_tiles(means2d[None], radii[None], depths[None], tile_size, *grid)
        starts = impl._isect_offset_encode(keys, 1, *grid).flatten().tolist()
        return [ids[a:b].tolist() for a, b in itertools.pairwise([*starts, len(ids)])]

    return {"conics_from_covars2d": conics_from_covars2d, "compensations": compensations, "tile_lists": tile_lists}


def gsplat_torch(name: str, dtype: str) -> TorchAdapter:
    """Return the adapter of the torch stage functions."""
    return TorchAdapter(name, dtype=dtype, profile=GSPLAT_1_5, stages=torch_stages())


def constants_of(version: str) -> Profile:
    """Return the constants of a version of gsplat, written as 1.5.3."""
    return GSPLAT_1_6 if tuple(int(part) for part in version.split(".")[:2]) >= (1, 6) else GSPLAT_1_5


def gsplat_cuda(name: str) -> TorchAdapter:
    """Return the adapter of `gsplat.rasterization` on the first GPU."""
    gsplat: Any = importlib.import_module("gsplat")
    profile = constants_of(gsplat.__version__)
    return TorchAdapter(
        name, gsplat.rasterization, dtype="float32", device="cuda", profile=profile, deterministic=False
    )
