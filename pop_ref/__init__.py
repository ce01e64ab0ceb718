"""The oracle: rendering, gradients, dominance, losses and density control, exactly and slowly, in NumPy float64."""

import sys
import warnings
from types import ModuleType
from typing import Any

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


class _Records(ModuleType):
    """The module `pop_ref.types` of older code: a file of that name shadows the standard library's."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        warnings.warn("pop_ref.types is now pop_ref.records", DeprecationWarning, stacklevel=2)
        return getattr(sys.modules["pop_ref.records"], name)


sys.modules["pop_ref.types"] = _Records("pop_ref.types")


def __getattr__(name: str) -> Any:
    if name != "Doubt":
        raise AttributeError(f"module 'pop_ref' has no attribute {name!r}")
    warnings.warn("pop_ref.Doubt is now pop_ref.CloseDecision", DeprecationWarning, stacklevel=2)
    return CloseDecision
