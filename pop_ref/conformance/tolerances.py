"""Every tolerance, once, with the worst case that was measured.

A tolerance is a number of units; one unit is eps of the backend's dtype times a magnitude that the law or the oracle
computes from absolute values. So a float32 backend is allowed its rounding and nothing else, and no tolerance depends
on where it runs. Against the oracle a float64 backend has to agree to 1e-12 of that same magnitude, or to 64 times the
units that single precision is allowed where that is less: its rounding alone is far smaller, so anything that is left
is a wrong formula.

`worst` is the largest number of units seen over all backends of this project under HYPOTHESIS_PROFILE=thorough
(`pytest tests/laws --record-worst`); `tests/meta` asserts that no tolerance is far above its worst case.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

# at float64 a formula that is wrong is wrong by more than this many times what single precision is allowed
ROOM_FLOAT64: Final = 64.0
AGREEMENT_FLOAT64: Final = 1e-12


@dataclass(frozen=True)
class Tolerance:
    """How many units a law forgives, and how many were ever needed.

    Attributes:
        units: allowed, in eps of the dtype times the magnitude.
        worst: measured.
    """

    units: float
    worst: float


TABLE: Final[dict[str, Tolerance]] = {
    "activations.norm": Tolerance(units=15, worst=1.5),
    "activations.opacities": Tolerance(units=8, worst=1),
    "activations.scales": Tolerance(units=4, worst=0.4),
    "activations.slope": Tolerance(units=1.5, worst=0.15),
    "adjoint": Tolerance(units=0.002, worst=0.00023),
    "agreement.T_final": Tolerance(units=25, worst=5.7),
    "agreement.camera_center": Tolerance(units=2, worst=0.24),
    "agreement.camera_center_vjp": Tolerance(units=3, worst=0.28),
    "agreement.centred_exposures": Tolerance(units=4, worst=0.35),
    "agreement.color_correct": Tolerance(units=0.8, worst=0.084),
    "agreement.colors_from_sh": Tolerance(units=6, worst=0.65),
    "agreement.colors_from_sh_vjp": Tolerance(units=8, worst=0.77),
    "agreement.compensations": Tolerance(units=3, worst=0.31),
    "agreement.compensations_vjp": Tolerance(units=150, worst=13),
    "agreement.conics_from_covars2d": Tolerance(units=3, worst=0.27),
    "agreement.conics_from_covars2d_vjp": Tolerance(units=6, worst=0.71),
    "agreement.covars_cam_from_covars": Tolerance(units=3, worst=0.28),
    "agreement.covars_cam_from_covars_vjp": Tolerance(units=4, worst=0.41),
    "agreement.covars_from_quats_scales": Tolerance(units=8, worst=1),
    "agreement.covars_from_quats_scales_vjp": Tolerance(units=50, worst=5.9),
    "agreement.d_ssim": Tolerance(units=0.008, worst=0.00091),
    "agreement.d_ssim_vjp": Tolerance(units=0.4, worst=0.042),
    "agreement.distance_sum": Tolerance(units=1.5, worst=0.13),
    "agreement.expose": Tolerance(units=1, worst=0),
    "agreement.expose_vjp": Tolerance(units=1, worst=0),
    "agreement.fisher_blocks": Tolerance(units=0.03, worst=0.0028),
    "agreement.image": Tolerance(units=30, worst=2.9),
    "agreement.l1": Tolerance(units=0.6, worst=0.074),
    "agreement.l1_vjp": Tolerance(units=0.6, worst=0.063),
    "agreement.l2": Tolerance(units=0.4, worst=0.043),
    "agreement.l2_vjp": Tolerance(units=2, worst=0.19),
    "agreement.losses": Tolerance(units=8, worst=0.99),
    "agreement.losses_vjp": Tolerance(units=5, worst=0.57),
    "agreement.low_pass": Tolerance(units=1, worst=0),
    "agreement.low_pass_vjp": Tolerance(units=1, worst=0),
    "agreement.map_sum": Tolerance(units=1, worst=0),
    "agreement.mean_activation": Tolerance(units=4, worst=0.37),
    "agreement.mean_activation_vjp": Tolerance(units=1, worst=0),
    "agreement.means_cam_from_means": Tolerance(units=2, worst=0.23),
    "agreement.means_cam_from_means_vjp": Tolerance(units=3, worst=0.26),
    "agreement.opacities_from_logits": Tolerance(units=3, worst=0.31),
    "agreement.opacities_from_logits_vjp": Tolerance(units=1500, worst=130),
    "agreement.over_background": Tolerance(units=1, worst=0),
    "agreement.photometric_3dgs": Tolerance(units=0.003, worst=0.00029),
    "agreement.photometric_3dgs_vjp": Tolerance(units=0.08, worst=0.0097),
    "agreement.photometric_pop": Tolerance(units=0.0006, worst=6.5e-05),
    "agreement.photometric_pop_vjp": Tolerance(units=0.006, worst=0.00066),
    "agreement.points": Tolerance(units=2, worst=0.23),
    "agreement.points.T_final": Tolerance(units=50, worst=5.1),
    "agreement.pop_loss": Tolerance(units=3, worst=0.35),
    "agreement.pop_loss_vjp": Tolerance(units=1, worst=0),
    "agreement.project_covars": Tolerance(units=1, worst=0),
    "agreement.project_covars_vjp": Tolerance(units=1, worst=0),
    "agreement.project_means": Tolerance(units=1.5, worst=0.18),
    "agreement.project_means_vjp": Tolerance(units=1.5, worst=0.14),
    "agreement.projection_jacobians": Tolerance(units=1.5, worst=0.14),
    "agreement.projection_jacobians_vjp": Tolerance(units=4, worst=0.46),
    "agreement.refined_viewmat": Tolerance(units=2, worst=0.23),
    "agreement.refined_viewmat_vjp": Tolerance(units=5, worst=0.52),
    "agreement.rotmats_from_quats": Tolerance(units=8, worst=1),
    "agreement.rotmats_from_quats_vjp": Tolerance(units=20, worst=2),
    "agreement.scales_from_log_scales": Tolerance(units=2, worst=0.25),
    "agreement.scales_from_log_scales_vjp": Tolerance(units=3, worst=0.26),
    "agreement.screen_moments": Tolerance(units=20, worst=2.2),
    "agreement.sensitivity": Tolerance(units=8, worst=0.94),
    "agreement.sh_basis": Tolerance(units=3, worst=0.28),
    "agreement.sh_basis_vjp": Tolerance(units=5, worst=0.56),
    "agreement.sparse_depth_loss": Tolerance(units=40, worst=5),
    "agreement.sparse_depth_loss_vjp": Tolerance(units=16, worst=1.8),
    "agreement.ssim": Tolerance(units=0.008, worst=0.00088),
    "agreement.ssim_vjp": Tolerance(units=0.4, worst=0.076),
    "agreement.unit_quats_from_quats": Tolerance(units=3, worst=0.3),
    "agreement.unit_quats_from_quats_vjp": Tolerance(units=15, worst=1.7),
    "agreement.v_background": Tolerance(units=8, worst=0.92),
    "agreement.v_colors": Tolerance(units=0.6, worst=0.066),
    "agreement.v_means": Tolerance(units=0.4, worst=0.098),
    "agreement.v_means2d": Tolerance(units=0.4, worst=0.047),
    "agreement.v_means2d_abs": Tolerance(units=0.4, worst=0.045),
    "agreement.v_opacities": Tolerance(units=3, worst=0.26),
    "agreement.v_quats": Tolerance(units=0.03, worst=0.0029),
    "agreement.v_scales": Tolerance(units=0.5, worst=0.061),
    "agreement.v_sh": Tolerance(units=20, worst=2),
    "agreement.v_viewmat": Tolerance(units=0.2, worst=0.043),
    "agreement.view_dirs": Tolerance(units=1.5, worst=0.16),
    "agreement.view_dirs_vjp": Tolerance(units=1.5, worst=0.18),
    "agreement.weight": Tolerance(units=12, worst=2.7),
    "agreement.weight_sum": Tolerance(units=30, worst=3),
    "alpha.alpha": Tolerance(units=1, worst=0),
    "alpha.falloff": Tolerance(units=2, worst=0.19),
    "alpha.gradient": Tolerance(units=3, worst=0.31),
    "alpha.sigma": Tolerance(units=8, worst=0.98),
    "autograd.image": Tolerance(units=1, worst=0),
    "autograd.v_background": Tolerance(units=0.1, worst=0.0094),
    "autograd.v_means": Tolerance(units=0.006, worst=0.0005),
    "autograd.v_opacities": Tolerance(units=0.1, worst=0.0082),
    "autograd.v_quats": Tolerance(units=0.0003, worst=2.5e-05),
    "autograd.v_scales": Tolerance(units=0.002, worst=0.00015),
    "autograd.v_sh": Tolerance(units=0.4, worst=0.034),
    "autograd.v_viewmat": Tolerance(units=0.0006, worst=4.3e-05),
    "camera.covariance": Tolerance(units=100, worst=11),
    "camera.dirs": Tolerance(units=3, worst=0.34),
    "camera.rigid": Tolerance(units=40, worst=4.1),
    "chord.densest": Tolerance(units=15, worst=1.5),
    "chord.ray": Tolerance(units=6, worst=0.74),
    "compositing.background": Tolerance(units=1.5, worst=0.13),
    "compositing.copies": Tolerance(units=20, worst=2.5),
    "compositing.formula": Tolerance(units=150, worst=15),
    "compositing.linear": Tolerance(units=0.6, worst=0.064),
    "compositing.order": Tolerance(units=1, worst=0),
    "compositing.split": Tolerance(units=1, worst=0.12),
    "compositing.stop": Tolerance(units=80, worst=9.5),
    "compositing.sum": Tolerance(units=0.6, worst=0.07),
    "contributions.color": Tolerance(units=30, worst=2.6),
    "contributions.cover": Tolerance(units=10, worst=1.1),
    "contributions.rows": Tolerance(units=1, worst=0),
    "covariance.conjugation": Tolerance(units=150, worst=16),
    "covariance.eigenvalues": Tolerance(units=80, worst=7.6),
    "covariance.isotropic": Tolerance(units=60, worst=6.4),
    "covariance.orthogonal": Tolerance(units=150, worst=17),
    "covariance.rotation": Tolerance(units=50, worst=6.1),
    "density.average": Tolerance(units=3, worst=0.34),
    "density.reset": Tolerance(units=0.08, worst=0.0086),
    "density.split": Tolerance(units=6, worst=0.67),
    "density.step": Tolerance(units=6, worst=0.65),
    "dominance.weight": Tolerance(units=1, worst=0),
    "few_photographs.depth": Tolerance(units=5, worst=0.61),
    "few_photographs.depth_vjp": Tolerance(units=8, worst=0.9),
    "few_photographs.exposures": Tolerance(units=4, worst=0.38),
    "few_photographs.learned": Tolerance(units=2.7, worst=0.27),
    "few_photographs.motion": Tolerance(units=12, worst=1.2),
    "few_photographs.places": Tolerance(units=0.9, worst=0.087),
    "fisher.log_det": Tolerance(units=1, worst=0.12),
    "fisher.rows": Tolerance(units=1, worst=0),
    "fisher.units": Tolerance(units=2, worst=0.2),
    "footprint.energy": Tolerance(units=20, worst=1.9),
    "footprint.inverse": Tolerance(units=4, worst=0.5),
    "footprint.low_pass": Tolerance(units=4, worst=0.49),
    "gradients.absgrad": Tolerance(units=0.15, worst=0.013),
    "gradients.background": Tolerance(units=200, worst=22),
    "gradients.color": Tolerance(units=2, worst=0.22),
    "gradients.difference": Tolerance(units=0.08, worst=0.0078),
    "gradients.instruments": Tolerance(units=50, worst=4.9),
    "gradients.instruments.image": Tolerance(units=50, worst=4.9),
    "gradients.radial": Tolerance(units=0.004, worst=0.00043),
    "gradients.rigid": Tolerance(units=0.003, worst=0.00027),
    "gradients.sum.background": Tolerance(units=0.4, worst=0.049),
    "gradients.sum.means": Tolerance(units=0.04, worst=0.004),
    "gradients.sum.means2d": Tolerance(units=0.04, worst=0.0041),
    "gradients.sum.means2d_abs": Tolerance(units=0.015, worst=0.0016),
    "gradients.sum.opacities": Tolerance(units=0.08, worst=0.01),
    "gradients.sum.quats": Tolerance(units=0.02, worst=0.0023),
    "gradients.sum.scales": Tolerance(units=0.2, worst=0.025),
    "gradients.sum.sh": Tolerance(units=0.4, worst=0.05),
    "gradients.sum.viewmat": Tolerance(units=0.04, worst=0.0049),
    "harmonics.colors": Tolerance(units=4, worst=0.4),
    "harmonics.energy": Tolerance(units=50, worst=5.4),
    "harmonics.lower": Tolerance(units=8, worst=0.87),
    "harmonics.orthogonal": Tolerance(units=1.5, worst=0.15),
    "harmonics.values": Tolerance(units=1.5, worst=0.13),
    "losses.flat": Tolerance(units=40, worst=4.6),
    "losses.gradient": Tolerance(units=5, worst=0.57),
    "losses.mean": Tolerance(units=1.5, worst=0.13),
    "losses.mix": Tolerance(units=2, worst=0.25),
    "losses.ssim": Tolerance(units=30, worst=3.5),
    "meta.rows": Tolerance(units=3, worst=0.33),
    "mini_splatting.outdoors": Tolerance(units=4, worst=0.38),
    "mini_splatting.scales": Tolerance(units=2, worst=0.2),
    "mini_splatting.sum": Tolerance(units=3, worst=0.37),
    "optimizer.adam": Tolerance(units=6, worst=0.52),
    "optimizer.rate": Tolerance(units=1, worst=0),
    "optimizer.scale": Tolerance(units=80, worst=9),
    "polarization.gradient": Tolerance(units=4, worst=0.38),
    "polarization.loss": Tolerance(units=4, worst=0.5),
    "projection.axis": Tolerance(units=2, worst=0.25),
    "projection.clamp": Tolerance(units=3, worst=0.3),
    "projection.clamp_gradient": Tolerance(units=1, worst=0),
    "projection.covariance": Tolerance(units=1, worst=0),
    "projection.jacobian": Tolerance(units=1.5, worst=0.15),
    "projection.shift": Tolerance(units=3, worst=0.35),
    "scale.T_final": Tolerance(units=20, worst=2.1),
    "scale.image": Tolerance(units=0.15, worst=0.017),
    "scale.pixels.T_final": Tolerance(units=80, worst=7.9),
    "scale.pixels.image": Tolerance(units=0.15, worst=0.018),
    "scale.v_background": Tolerance(units=6, worst=0.61),
    "scale.v_means": Tolerance(units=0.002, worst=0.00023),
    "scale.v_means2d": Tolerance(units=0.004, worst=0.00043),
    "scale.v_means2d_abs": Tolerance(units=0.008, worst=0.00086),
    "scale.v_opacities": Tolerance(units=0.02, worst=0.002),
    "scale.v_quats": Tolerance(units=4e-05, worst=4.2e-06),
    "scale.v_scales": Tolerance(units=0.0004, worst=4.4e-05),
    "scale.v_sh": Tolerance(units=0.8, worst=0.082),
    "scale.v_viewmat": Tolerance(units=0.0001, worst=1.3e-05),
    "sensitivity.light": Tolerance(units=0.8, worst=0.088),
    "sensitivity.one": Tolerance(units=1, worst=0),
    "sensitivity.rows": Tolerance(units=1, worst=0),
    "sensitivity.square": Tolerance(units=1, worst=0),
    "steps.coarse": Tolerance(units=40, worst=4),
    "steps.loss": Tolerance(units=0.6, worst=0.06),
    "steps.means": Tolerance(units=0.013, worst=0.0013),
    "steps.opacities": Tolerance(units=4, worst=0.43),
    "steps.params": Tolerance(units=5, worst=0.6),
    "steps.quats": Tolerance(units=0.00013, worst=1.31e-05),
    "steps.scales": Tolerance(units=4, worst=0.45),
    "steps.sh0": Tolerance(units=0.9, worst=0.092),
    "steps.shN": Tolerance(units=0.75, worst=0.076),
    "steps.squares": Tolerance(units=5, worst=0.5),
    "steps.still": Tolerance(units=12, worst=1.2),
    "taming.median": Tolerance(units=8, worst=0.96),
    "taming.pixel_weights": Tolerance(units=10, worst=1.1),
    "taming.score": Tolerance(units=20, worst=1.9),
    "tight_tiles.box": Tolerance(units=6, worst=0.72),
    "training.blocks": Tolerance(units=3000, worst=340),
    "training.collected": Tolerance(units=0.002, worst=0.00022),
    "training.extents": Tolerance(units=4, worst=0.45),
    "training.passes": Tolerance(units=1, worst=0.12),
    "training.regularizers": Tolerance(units=15, worst=1.7),
    "training.rows": Tolerance(units=80, worst=9.8),
    "training.term": Tolerance(units=16, worst=1.9),
    "training.waiting": Tolerance(units=0.1, worst=0.012),
    "whole.crop": Tolerance(units=10, worst=1.2),
    "whole.invisible": Tolerance(units=30, worst=5.5),
    "whole.mirror": Tolerance(units=80, worst=7.8),
    "whole.permutation": Tolerance(units=1, worst=0),
    "whole.rigid": Tolerance(units=8, worst=0.93),
    "whole.tiles": Tolerance(units=30, worst=3),
}

_seen: dict[tuple[str, str], float] = {}


def allowed(key: str, dtype: Any) -> float:
    """Return the allowed difference per magnitude for a law's key and a dtype."""
    return TABLE[key].units * float(np.finfo(dtype).eps)


def agreement(key: str, dtype: Any) -> float:
    """Return the allowed difference per magnitude from the oracle: rounding only, at float64 with room, up to 1e-12.

    A float64 backend is judged on worse conditioned scenes, which single precision cannot resolve.
    """
    return min(AGREEMENT_FLOAT64, ROOM_FLOAT64 * allowed(key, dtype)) if dtype == np.float64 else allowed(key, dtype)


def record(key: str, dtype: Any, units: float) -> None:
    """Remember the largest number of units that a comparison needed."""
    slot = (key, np.dtype(dtype).name)
    _seen[slot] = max(_seen.get(slot, 0.0), units)


def measured() -> dict[tuple[str, str], float]:
    """Return the largest number of units seen since the start, by key and dtype."""
    return dict(_seen)
