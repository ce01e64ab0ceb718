"""The oracle: rendering, gradients, dominance, losses and density control, exactly and slowly, in NumPy float64."""

from pop_ref.constants import (
    DECISIONS,
    GSPLAT_1_5,
    GSPLAT_1_6,
    INRIA,
    KINKS,
    PAPER,
    PROFILES,
    SPEEDY_SPLAT,
    Profile,
    profile_named,
)
from pop_ref.margins import CloseDecision, Margins, margins
from pop_ref.records import Camera, Gaussians, Render, Splats
from pop_ref.render import RenderGradients, render, render_vjp
from pop_ref.splatting import project, project_vjp

__all__ = [
    "Camera",
    "Gaussians",
    "Splats",
    "Render",
    "RenderGradients",
    "Profile",
    "PAPER",
    "GSPLAT_1_5",
    "GSPLAT_1_6",
    "INRIA",
    "SPEEDY_SPLAT",
    "PROFILES",
    "profile_named",
    "DECISIONS",
    "KINKS",
    "project",
    "project_vjp",
    "render",
    "render_vjp",
    "margins",
    "Margins",
    "CloseDecision",
]
