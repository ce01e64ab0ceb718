"""Adapters for other people's rasterizers: gsplat 1.5, and Inria's diff-gaussian-rasterization.

gsplat's functions in plain torch, which its own tests compare with, run on a CPU. They are its private reference, so
their names may move between versions; the adapter was written against 1.5.3. Their extents leave out the opacity, so
culling is not judged; conics and the antialiasing's factors are read from the fused projection of splats that a unit
camera sees straight on.

Inria's takes transposed matrices, tangents of half the field of view and unit quaternions, returns the image channels
first, and shows neither alpha nor screen centres; the remaining transmittance is what a second render of black splats
shows of a white background. Background and view matrix have no gradients there. Nothing of either is imported unasked.
"""

from __future__ import annotations

import importlib
import itertools
import re
from collections.abc import Callable
from typing import Any

from pop_ref.conformance.capabilities import ANTIALIASING
from pop_ref.conformance.torch_adapter import TorchAdapter
from pop_ref.constants import GSPLAT_1_5, GSPLAT_1_6, INRIA, Profile


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
    """Return the constants of a version of gsplat, written as 1.5.3 or 1.6rc1."""
    return GSPLAT_1_6 if tuple(int(part) for part in re.findall(r"\d+", version)[:2]) >= (1, 6) else GSPLAT_1_5


def gsplat_cuda(name: str) -> TorchAdapter:
    """Return the adapter of `gsplat.rasterization` on the first GPU."""
    gsplat: Any = importlib.import_module("gsplat")
    profile = constants_of(gsplat.__version__)
    return TorchAdapter(
        name, gsplat.rasterization, dtype="float32", device="cuda", profile=profile, deterministic=False
    )


MODULE = "diff_gaussian_rasterization"
# planes of its projection matrix; they move neither a pixel nor the near-plane test, which is on camera z
NEAR, FAR = 0.01, 100.0


def gsplat_like(module: Any) -> Callable[..., Any]:
    """Return the module's rasterizer as a function of gsplat's arguments, for one camera.

    Args:
        module: has GaussianRasterizationSettings and GaussianRasterizer.
    """
    torch: Any = importlib.import_module("torch")
    blurs = "antialiasing" in module.GaussianRasterizationSettings._fields

    def rasterization(
        means: Any,
        quats: Any,
        scales: Any,
        opacities: Any,
        colors: Any,
        viewmats: Any,
        Ks: Any,
        width: int,
        height: int,
        sh_degree: int | None = None,
        backgrounds: Any = None,
        rasterize_mode: str = "classic",
        **_others: Any,
    ) -> tuple[Any, Any, dict[str, Any]]:
        size = torch.tensor([width, height], dtype=means.dtype, device=means.device)
        points = torch.zeros((len(means), 2), dtype=means.dtype, device=means.device, requires_grad=means.requires_grad)
        # its gradient of a screen centre is in halves of the image
        means2d = torch.nn.functional.pad(points * 2.0 / size, (0, 1))
        common = {
            "means3D": means,
            "means2D": means2d,
            "opacities": opacities[:, None],
            "scales": scales,
            "rotations": torch.nn.functional.normalize(quats),
        }
        antialiased = {"antialiasing": rasterize_mode == "antialiased"} if blurs else {}

        def drawn(background: Any, **chosen: Any) -> Any:
            camera = _camera(torch, viewmats[0].detach(), Ks[0], width, height)
            settings = module.GaussianRasterizationSettings(
                image_height=height,
                image_width=width,
                **camera,
                bg=background,
                scale_modifier=1.0,
                sh_degree=sh_degree,
                prefiltered=False,
                debug=False,
                **antialiased,
            )
            # newer versions return inverse depths as well
            image, radii, *_ = module.GaussianRasterizer(settings)(**common, **chosen)
            return image.permute(1, 2, 0), radii

        image, radii = drawn(backgrounds[0].detach(), shs=colors)
        transmittance, _ = drawn(torch.ones_like(backgrounds[0]), colors_precomp=torch.zeros_like(means))
        meta = {"radii": radii[:, None].repeat(1, 2), **({"means2d": points} if points.requires_grad else {})}
        return image[None], 1.0 - transmittance[None, :, :, :1], meta

    return rasterization


def _camera(torch: Any, viewmat: Any, K: Any, width: int, height: int) -> dict[str, Any]:
    tan_x, tan_y = 0.5 * width / float(K[0, 0]), 0.5 * height / float(K[1, 1])
    projection = torch.zeros((4, 4), dtype=viewmat.dtype, device=viewmat.device)
    projection[0, 0], projection[1, 1], projection[3, 2] = 1.0 / tan_x, 1.0 / tan_y, 1.0
    projection[2, 2], projection[2, 3] = FAR / (FAR - NEAR), -FAR * NEAR / (FAR - NEAR)
    return {
        "tanfovx": tan_x,
        "tanfovy": tan_y,
        "viewmatrix": viewmat.T.contiguous(),
        "projmatrix": (projection @ viewmat).T.contiguous(),
        "campos": -viewmat[:3, :3].T @ viewmat[:3, 3],
    }


def inria(name: str, module: Any = None, dtype: str = "float32", device: str = "cuda") -> TorchAdapter:
    """Return the adapter; by default of the installed package, on the first GPU.

    Raises:
        ModuleNotFoundError: torch or the package is not installed.
    """
    module = importlib.import_module(MODULE) if module is None else module
    without = ("background", "viewmat")
    adapter = TorchAdapter(
        name,
        gsplat_like(module),
        dtype=dtype,
        device=device,
        profile=INRIA,
        without_gradients=without,
        deterministic=False,
        whole_signature=False,
    )
    adapter.able = (ANTIALIASING,) if "antialiasing" in module.GaussianRasterizationSettings._fields else ()
    return adapter
