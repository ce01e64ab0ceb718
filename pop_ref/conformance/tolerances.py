"""Every tolerance, once, with the worst case that was measured.

A tolerance is a number of units; one unit is eps of the backend's dtype times a magnitude that the law or the oracle
computes from absolute values. So a float32 backend is charged its rounding and nothing else, and no tolerance depends
on where it runs. Against the oracle a float64 backend has to agree to 1e-10 of that same magnitude: its rounding alone
is far smaller, so anything that is left is a wrong formula.

`worst` is the largest number of units seen over all backends of this project under HYPOTHESIS_PROFILE=thorough
(`pytest tests/laws --record-worst`); `tests/meta` asserts that no tolerance is far above its worst case.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

AGREEMENT_FLOAT64: Final = 1e-10


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
    "activations.norm": Tolerance(units=6, worst=1.5),
    "activations.opacities": Tolerance(units=4, worst=1),
    "activations.scales": Tolerance(units=1.5, worst=0.26),
    "adjoint": Tolerance(units=0.002, worst=0.00044),
    "agreement.T_final": Tolerance(units=8, worst=2),
    "agreement.camera_center": Tolerance(units=1, worst=0.2),
    "agreement.colors_from_sh": Tolerance(units=1.5, worst=0.37),
    "agreement.colors_from_sh_vjp": Tolerance(units=4, worst=0.88),
    "agreement.compensations": Tolerance(units=1, worst=0.21),
    "agreement.compensations_vjp": Tolerance(units=30, worst=5.2),
    "agreement.conics_from_covars2d": Tolerance(units=1, worst=0.17),
    "agreement.conics_from_covars2d_vjp": Tolerance(units=2, worst=0.46),
    "agreement.covars_cam_from_covars": Tolerance(units=1, worst=0.17),
    "agreement.covars_cam_from_covars_vjp": Tolerance(units=1.5, worst=0.36),
    "agreement.covars_from_quats_scales": Tolerance(units=4, worst=0.95),
    "agreement.covars_from_quats_scales_vjp": Tolerance(units=8, worst=1.8),
    "agreement.d_ssim": Tolerance(units=0.004, worst=0.00085),
    "agreement.d_ssim_vjp": Tolerance(units=0.15, worst=0.036),
    "agreement.image": Tolerance(units=4, worst=0.87),
    "agreement.l1": Tolerance(units=1, worst=0.061),
    "agreement.l1_vjp": Tolerance(units=1, worst=0.063),
    "agreement.l2": Tolerance(units=1, worst=0.043),
    "agreement.l2_vjp": Tolerance(units=1, worst=0.19),
    "agreement.low_pass": Tolerance(units=1, worst=0),
    "agreement.low_pass_vjp": Tolerance(units=1, worst=0),
    "agreement.means_cam_from_means": Tolerance(units=1, worst=0.14),
    "agreement.means_cam_from_means_vjp": Tolerance(units=1, worst=0.24),
    "agreement.opacities_from_logits": Tolerance(units=1.5, worst=0.28),
    "agreement.opacities_from_logits_vjp": Tolerance(units=400, worst=95),
    "agreement.photometric_3dgs": Tolerance(units=0.0015, worst=0.00032),
    "agreement.photometric_3dgs_vjp": Tolerance(units=0.04, worst=0.0097),
    "agreement.photometric_pop": Tolerance(units=0.0003, worst=6.5e-05),
    "agreement.photometric_pop_vjp": Tolerance(units=0.003, worst=0.00054),
    "agreement.pop_loss": Tolerance(units=2, worst=0.38),
    "agreement.pop_loss_vjp": Tolerance(units=1, worst=0),
    "agreement.project_covars": Tolerance(units=1, worst=0),
    "agreement.project_covars_vjp": Tolerance(units=1, worst=0),
    "agreement.project_means": Tolerance(units=1, worst=0.14),
    "agreement.project_means_vjp": Tolerance(units=1, worst=0.16),
    "agreement.projection_jacobians": Tolerance(units=1, worst=0.18),
    "agreement.projection_jacobians_vjp": Tolerance(units=2, worst=0.46),
    "agreement.rotmats_from_quats": Tolerance(units=4, worst=0.92),
    "agreement.rotmats_from_quats_vjp": Tolerance(units=4, worst=0.76),
    "agreement.scales_from_log_scales": Tolerance(units=1, worst=0.15),
    "agreement.scales_from_log_scales_vjp": Tolerance(units=1, worst=0.25),
    "agreement.sh_basis": Tolerance(units=1.5, worst=0.27),
    "agreement.sh_basis_vjp": Tolerance(units=2, worst=0.5),
    "agreement.ssim": Tolerance(units=0.004, worst=0.00085),
    "agreement.ssim_vjp": Tolerance(units=0.15, worst=0.036),
    "agreement.unit_quats_from_quats": Tolerance(units=1, worst=0.25),
    "agreement.unit_quats_from_quats_vjp": Tolerance(units=5, worst=1.1),
    "agreement.v_background": Tolerance(units=0.4, worst=0.098),
    "agreement.v_means": Tolerance(units=0.06, worst=0.014),
    "agreement.v_means2d": Tolerance(units=0.06, worst=0.015),
    "agreement.v_means2d_abs": Tolerance(units=0.1, worst=0.025),
    "agreement.v_opacities": Tolerance(units=0.2, worst=0.045),
    "agreement.v_quats": Tolerance(units=0.0008, worst=0.00017),
    "agreement.v_scales": Tolerance(units=0.03, worst=0.0055),
    "agreement.v_sh": Tolerance(units=1, worst=0.25),
    "agreement.v_viewmat": Tolerance(units=0.015, worst=0.0031),
    "agreement.view_dirs": Tolerance(units=1, worst=0.18),
    "agreement.view_dirs_vjp": Tolerance(units=1, worst=0.076),
    "agreement.weight": Tolerance(units=15, worst=2.9),
    "alpha.alpha": Tolerance(units=1, worst=0),
    "alpha.falloff": Tolerance(units=1, worst=0.092),
    "alpha.gradient": Tolerance(units=1, worst=0.19),
    "alpha.sigma": Tolerance(units=4, worst=0.97),
    "camera.covariance": Tolerance(units=40, worst=7.9),
    "camera.dirs": Tolerance(units=1.5, worst=0.36),
    "camera.rigid": Tolerance(units=15, worst=3.2),
    "compositing.background": Tolerance(units=1, worst=0.069),
    "compositing.copies": Tolerance(units=10, worst=2.5),
    "compositing.formula": Tolerance(units=40, worst=8.5),
    "compositing.linear": Tolerance(units=1, worst=0.088),
    "compositing.order": Tolerance(units=1, worst=0),
    "compositing.split": Tolerance(units=1.5, worst=0.27),
    "compositing.stop": Tolerance(units=30, worst=6.9),
    "compositing.sum": Tolerance(units=1, worst=0.051),
    "covariance.conjugation": Tolerance(units=30, worst=6.5),
    "covariance.eigenvalues": Tolerance(units=20, worst=5),
    "covariance.isotropic": Tolerance(units=20, worst=5),
    "covariance.orthogonal": Tolerance(units=40, worst=7.9),
    "covariance.rotation": Tolerance(units=20, worst=5),
    "density.average": Tolerance(units=1.5, worst=0.29),
    "density.reset": Tolerance(units=1, worst=0.0086),
    "density.split": Tolerance(units=2, worst=0.46),
    "dominance.weight": Tolerance(units=1, worst=0),
    "footprint.energy": Tolerance(units=2, worst=0.44),
    "footprint.inverse": Tolerance(units=2, worst=0.5),
    "footprint.low_pass": Tolerance(units=1, worst=0),
    "gradients.absgrad": Tolerance(units=0.15, worst=0.03),
    "gradients.background": Tolerance(units=80, worst=20),
    "gradients.color": Tolerance(units=0.3, worst=0.062),
    "gradients.difference": Tolerance(units=0.008, worst=0.0017),
    "gradients.radial": Tolerance(units=1.5e-05, worst=3.7e-06),
    "gradients.rigid": Tolerance(units=0.0005, worst=0.00011),
    "gradients.sum.background": Tolerance(units=0.2, worst=0.047),
    "gradients.sum.means": Tolerance(units=0.004, worst=0.00087),
    "gradients.sum.means2d": Tolerance(units=0.003, worst=0.0006),
    "gradients.sum.means2d_abs": Tolerance(units=0.008, worst=0.0016),
    "gradients.sum.opacities": Tolerance(units=0.015, worst=0.0027),
    "gradients.sum.quats": Tolerance(units=0.00015, worst=2.8e-05),
    "gradients.sum.scales": Tolerance(units=0.0015, worst=0.00034),
    "gradients.sum.sh": Tolerance(units=0.2, worst=0.043),
    "gradients.sum.viewmat": Tolerance(units=0.003, worst=0.00061),
    "harmonics.colors": Tolerance(units=2, worst=0.45),
    "harmonics.energy": Tolerance(units=20, worst=4.5),
    "harmonics.orthogonal": Tolerance(units=1, worst=0.094),
    "harmonics.values": Tolerance(units=1, worst=0.13),
    "losses.flat": Tolerance(units=20, worst=4.6),
    "losses.gradient": Tolerance(units=3, worst=0.57),
    "losses.mean": Tolerance(units=1, worst=0.13),
    "losses.mix": Tolerance(units=1, worst=0.13),
    "losses.ssim": Tolerance(units=6, worst=1.5),
    "optimizer.adam": Tolerance(units=5, worst=1.2),
    "optimizer.rate": Tolerance(units=1, worst=0),
    "optimizer.scale": Tolerance(units=800, worst=200),
    "polarization.gradient": Tolerance(units=1.5, worst=0.26),
    "polarization.loss": Tolerance(units=2, worst=0.5),
    "projection.axis": Tolerance(units=1, worst=0.1),
    "projection.clamp": Tolerance(units=1, worst=0.25),
    "projection.clamp_gradient": Tolerance(units=1, worst=0),
    "projection.covariance": Tolerance(units=1, worst=0),
    "projection.jacobian": Tolerance(units=1, worst=0.096),
    "projection.shift": Tolerance(units=1, worst=0.049),
    "whole.crop": Tolerance(units=3, worst=0.52),
    "whole.invisible": Tolerance(units=1, worst=0),
    "whole.mirror": Tolerance(units=20, worst=4.3),
    "whole.permutation": Tolerance(units=1, worst=0),
    "whole.rigid": Tolerance(units=1, worst=0.2),
    "whole.tiles": Tolerance(units=8, worst=1.7),
}

_seen: dict[tuple[str, str], float] = {}


def allowed(key: str, dtype: Any) -> float:
    """Return the allowed difference per magnitude for a law's key and a dtype."""
    return TABLE[key].units * float(np.finfo(dtype).eps)


def agreement(key: str, dtype: Any) -> float:
    """Return the allowed difference per magnitude from the oracle: 1e-10 at float64, rounding only at float32."""
    return AGREEMENT_FLOAT64 if dtype == np.float64 else allowed(key, dtype)


def record(key: str, dtype: Any, units: float) -> None:
    """Remember the largest number of units that a comparison needed."""
    slot = (key, np.dtype(dtype).name)
    _seen[slot] = max(_seen.get(slot, 0.0), units)


def measured() -> dict[tuple[str, str], float]:
    """Return the largest number of units seen since the start, by key and dtype."""
    return dict(_seen)
