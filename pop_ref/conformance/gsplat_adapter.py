"""Adapters for gsplat 1.5: its CUDA rasterizer, and the stage functions in plain torch that its tests compare with.

gsplat's torch functions run on a CPU. They are its private reference, so their names may move between versions; the
adapter was written against 1.5.3. Their extents leave out the opacity, so footprint and culling are not judged.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from pop_ref.conformance.torch_adapter import TorchAdapter
from pop_ref.constants import GSPLAT_1_5, GSPLAT_1_6, Profile


def torch_stages() -> dict[str, Callable[..., Any]]:
    """Return gsplat's torch functions under the oracle's names, one camera, no batch."""
    impl: Any = importlib.import_module("gsplat.cuda._torch_impl")
    torch: Any = importlib.import_module("torch")

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


def gsplat_torch(name: str, dtype: str) -> TorchAdapter:
    """Return the adapter of the torch stage functions."""
    return TorchAdapter(name, dtype=dtype, profile=GSPLAT_1_5, stages=torch_stages())


def gsplat_cuda(name: str) -> TorchAdapter:
    """Return the adapter of `gsplat.rasterization` on the first GPU."""
    gsplat: Any = importlib.import_module("gsplat")
    version = tuple(int(part) for part in gsplat.__version__.split(".")[:2])
    profile = GSPLAT_1_6 if version >= (1, 6) else GSPLAT_1_5
    return TorchAdapter(name, gsplat.rasterization, dtype="float32", device="cuda", profile=profile)
