"""The course: thirteen stages in the order of the pipeline, what each is made of, and which laws judge it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final


@dataclass(frozen=True)
class Stage:
    """One module that a student writes.

    Attributes:
        name: of the stage and its file.
        does: what it does, in a few words.
        chapter: the walk-through's chapter that explains it, unless what follows names another.
        functions: the oracle's functions, by the oracle's module that has them.
        laws: the kit's stages whose laws judge it.
        more_laws: names of single laws of other stages.
        transposes: the chapter that explains its functions' transposes, where that is another one.
        elsewhere: the chapters of functions that yet another one explains, by function.
    """

    name: str
    does: str
    chapter: str
    functions: dict[str, tuple[str, ...]]
    laws: tuple[str, ...] = ()
    more_laws: tuple[str, ...] = ()
    transposes: str = ""
    elsewhere: dict[str, str] = field(default_factory=dict[str, str])

    def chapter_of(self, name: str) -> str:
        """Return the chapter that explains a function.

        Example:
            >>> stage_named("compositing").chapter_of("composite_pixel_vjp")
            '5'
        """
        usual = self.transposes if self.transposes and name.endswith("_vjp") else self.chapter
        return self.elsewhere.get(name, usual)

    def home_of(self, name: str) -> str:
        """Return the oracle's module that has a function."""
        return next(home for home, names in self.functions.items() if name in names)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the functions, in the order in which a file has them."""
        return tuple(name for names in self.functions.values() for name in names)

    @property
    def file(self) -> str:
        """Return the name of the student's file."""
        return f"{self.name}.py"


def _with_transposes(*names: str) -> tuple[str, ...]:
    return tuple(each for name in names for each in (name, f"{name}_vjp"))


_CAMERA: Final = ("camera_center", "view_dirs", "means_cam_from_means", "covars_cam_from_covars")
COURSE: Final = (
    Stage(
        "activations",
        "raw parameters to scales, opacities, unit quaternions",
        "1b",
        {"activations": _with_transposes("scales_from_log_scales", "opacities_from_logits", "unit_quats_from_quats")},
        ("activations",),
    ),
    Stage(
        "covariance",
        "quaternions and scales to ellipsoids",
        "2",
        {"covariance": _with_transposes("rotmats_from_quats", "covars_from_quats_scales")},
        ("covariance",),
        transposes="5b",
    ),
    Stage(
        "harmonics",
        "coefficients and directions to colours",
        "3",
        {"harmonics": _with_transposes("sh_basis", "colors_from_sh")},
        ("harmonics",),
        transposes="5b",
    ),
    Stage(
        "camera",
        "from the world into the camera's frame",
        "2",
        {"camera": (*_with_transposes(*_CAMERA), "in_front")},
        ("camera",),
        transposes="5b",
        elsewhere={"camera_center": "9b", "view_dirs": "3"},
    ),
    Stage(
        "projection",
        "from the camera's frame to the screen: ellipsoids to ellipses",
        "2",
        {"projection": _with_transposes("project_means", "projection_jacobians", "project_covars")},
        ("projection",),
        transposes="5b",
    ),
    Stage(
        "footprint",
        "a little blur, the inverse covariance, and how far a splat reaches",
        "2",
        {"footprint": (*_with_transposes("low_pass", "conics_from_covars2d"), "radii_from_covars2d", "on_screen")},
        ("footprint",),
        transposes="5b",
        elsewhere={"radii_from_covars2d": "1", "conics_from_covars2d": "1"},
    ),
    Stage(
        "tiles",
        "which splats a tile must look at, front to back",
        "4b",
        {"tiles": ("grid_size", "tile_span", "tile_rects", "tile_lists")},
        ("tiles",),
    ),
    Stage(
        "alpha",
        "one splat at one pixel",
        "1",
        {"alpha": _with_transposes("sigma_at_pixel", "falloff", "alpha_from_sigma")},
        ("alpha",),
        transposes="5",
    ),
    Stage(
        "compositing",
        "one pixel from front to back, its gradient from back to front, and what dominates it",
        "4",
        {"pixel": ("stops", *_with_transposes("composite_pixel")), "dominance": ("dominant_id", "dominant_counts")},
        ("compositing", "dominance"),
        (
            "zero_cotangents_give_exact_zeros",
            "gradients_are_the_oracles",
            "a_step_along_any_direction_changes_the_image_as_the_gradient_says",
        ),
        transposes="5",
        elsewhere={"dominant_id": "7", "dominant_counts": "7"},
    ),
    Stage(
        "losses",
        "how far a picture is from its photograph, and opacities from their poles",
        "6",
        {"losses": _with_transposes("l1", "l2"), "polarization": ("importance_mask", *_with_transposes("pop_loss"))},
        ("losses", "polarization"),
        elsewhere=dict.fromkeys(("importance_mask", "pop_loss", "pop_loss_vjp"), "8"),
    ),
    Stage("optimizer", "Adam, which moves every parameter", "1b", {"optimizer": ("adam_step",)}, ("optimizer",)),
    Stage(
        "density",
        "clone, split and prune: more Gaussians where they are needed, fewer where not",
        "9",
        {"density_rows": ("clone_rows", "split_rows", "prune_rows"), "density": ("grow_masks", "prune_mask")},
        ("density",),
    ),
    Stage(
        "loop",
        "render, compare, go back, step: what is repeated until the picture is right",
        "10",
        {"training": ("gaussians_from_params", "params_vjp", "look", "train_step")},
        elsewhere={"gaussians_from_params": "1b", "params_vjp": "1b"},
    ),
)

BY_NAME: Final = {stage.name: stage for stage in COURSE}
# laws of digits that no chapter teaches: o (1 - o), as chapter 1b writes it, loses them where a logit is far out, and
# R S S R^T, multiplied out entry by entry, is symmetric but for rounding
NOT_TAUGHT: Final = (
    "the_slope_of_an_opacity_is_the_same_at_both_poles",
    "covariances_are_symmetric_with_the_squared_scales_as_eigenvalues",
)
# what a student may pass and read of density control; chapter 9 teaches no other setting
DENSITY_SETTINGS: Final = (
    "grow_grad2d",
    "grow_scale3d",
    "prune_opa",
    "theta_blur",
    "blur_start_iter",
    "blur_stop_iter",
)


def stage_named(name: str) -> Stage:
    """Find a stage.

    Raises:
        ValueError: there is none of that name.

    Example:
        >>> stage_named("alpha").file
        'alpha.py'
    """
    if name not in BY_NAME:
        raise ValueError(f"'{name}' is not a stage of the course; there are {', '.join(BY_NAME)}")
    return BY_NAME[name]
