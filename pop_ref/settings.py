"""Every value that a training is decided by: density control, the loss, the optimizer, the schedule; no formula.

A constant of the method stands here and nowhere else. The oracle's recipes, the program's strategies and settings, the
command line and the CUDA step take their defaults from this module, which needs nothing but the renderer's constants.
Steps count from 0. Attributes name the ambiguities (A1 ... A29) that they decide.

Sources: POP paper, sections 3 and 4.1; Kerbl et al. 2023 and Inria's code; gsplat 1.5's default strategy and trainer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal

from pop_ref.constants import PAPER, Profile

Padding = Literal["valid", "same"]

# Adam's, of Inria's and of gsplat's trainer
BETAS: Final = (0.9, 0.999)
EPS: Final = 1e-15
# raw parameters in the order of Adam's groups, which the compiled steps share
PARAMETERS: Final = ("means", "scales", "quats", "opacities", "sh0", "shN")
# the last degree of the harmonics, and the loss of 3DGS: 0.8 L1 + 0.2 D-SSIM (eq. 2)
MAX_SH_DEGREE: Final = 3
LAMBDA_SSIM_3DGS: Final = 0.2
# a split replaces a Gaussian by so many, so many times smaller (Kerbl et al. 2023, section 5.2)
SPLIT_CHILDREN: Final = 2
SPLIT_SHRINK: Final = 1.6


@dataclass(frozen=True, kw_only=True)
class DensityConfig:
    """Every constant and every switch of density control; the defaults are POP's.

    Attributes:
        prune_opa: an opacity under it is pruned (A15: gsplat's default).
        grow_grad2d: tau_Den, in NDC units (A9: not retuned for L2).
        inclusive: True selects `>=` tau_Den as Inria does, False `>` as gsplat does.
        grad_denominator: "visible_views" averages over the views that saw the Gaussian, "window" over all (A23).
        grow_on_gradient: use the gradient rule, eq. 3 (A8: in addition to the blur rule).
        grow_on_gradient_in_blur_window: ... also inside the blur window, where else the blur rule works alone (A8).
        grow_scale3d: a Gaussian is small if its largest scale is at most this share of the scene's (A14).
        prune_too_big: prune Gaussians that grow excessively large (A16: off in POP, on where opacities are reset;
            gsplat and Inria's code apply this rule only after the first reset interval).
        prune_scale3d: excessively large is above this share of the scene's scale (A16).
        prune_too_big_after: ... and only at steps after this one, which is the reset interval in gsplat and in Inria's
            code (A16).
        refine_start_iter: densification steps happen at steps after it.
        refine_stop_iter: densification steps happen at steps before it (A17: pruning too ends there).
        refine_every: a densification step each so many steps (A17: pruning happens with each).
        theta_blur: share of a view's pixels above which a Gaussian is blurred (eq. 6; A18: of each view's own size).
        blur_min_pixels: and above at least so many pixels. The paper has no such bound and needs none: its smallest
            images (980 x 545) make theta_blur 10.7 pixels. In an image of 130,000 pixels theta_blur is 2.6, and nearly
            every Gaussian that can be seen would grow until it cannot.
        blur_start_iter: first step of the blur window, inclusive.
        blur_stop_iter: last step of the blur window, inclusive (A19); under `blur_start_iter` there is none.
        blur_window: "own_view" tests the densification step's own view only, "any_view" tests each view since the last
            one by itself and keeps the flag, "sum" adds the counts of those views up and tests the sum (A2).
        blur_rule: "by_scale" clones small blurred Gaussians and splits large ones, "split" splits all (A14).
        revised_opacity: split children get 1 - sqrt(1 - o) instead of o (A26).
        reset_every: reset opacities each so many steps before `refine_stop_iter`; 0 never (A22, A29).
        reset_at_zero: reset at step 0 as well, as gsplat up to 1.5.2 does (A25).
        reset_opa: the ceiling of a reset; gsplat couples it to `prune_opa`, as twice that.
        pause_refine_after_reset: steps after a reset without densification (gsplat's name; 0, as in its default).
        final_prune_iter: step after which opacities under `final_prune_opa` are pruned once more; -1 never.
        final_prune_opa: the opacity that survives that.
    """

    prune_opa: float = 0.005
    grow_grad2d: float = 2e-4
    inclusive: bool = False
    grad_denominator: Literal["visible_views", "window"] = "visible_views"
    grow_on_gradient: bool = True
    grow_on_gradient_in_blur_window: bool = True
    grow_scale3d: float = 0.01
    prune_too_big: bool = False
    prune_scale3d: float = 0.1
    prune_too_big_after: int = 3000
    refine_start_iter: int = 500
    refine_stop_iter: int = 15_000
    refine_every: int = 100
    theta_blur: float = 2e-5
    blur_min_pixels: float = 0.0
    blur_start_iter: int = 3000
    blur_stop_iter: int = 7000
    blur_window: Literal["any_view", "sum", "own_view"] = "own_view"
    blur_rule: Literal["by_scale", "split"] = "by_scale"
    revised_opacity: bool = False
    reset_every: int = 0
    reset_at_zero: bool = False
    reset_opa: float = 0.01
    pause_refine_after_reset: int = 0
    final_prune_iter: int = -1
    final_prune_opa: float = 0.05


@dataclass(frozen=True, kw_only=True)
class ScreenSizeRules:
    """What gsplat's default strategy can do besides and does not by default; Inria's test of radii never fires either.

    Attributes:
        grow_scale2d: extent, as a share of the longer image side, above which a Gaussian is split.
        prune_scale2d: extent, as a share of the longer image side, above which a Gaussian is pruned.
        refine_scale2d_stop_iter: step until which those two apply; 0 never.
    """

    grow_scale2d: float = 0.05
    prune_scale2d: float = 0.15
    refine_scale2d_stop_iter: int = 0


@dataclass(frozen=True, kw_only=True)
class PopTerm:
    """The Polarized Opacity Prior, `lambda_pop L_pop` (eqs. 7, 8).

    Attributes:
        lambda_pop: weight of the POP term; 0 leaves it out.
        pop_start_iter: first step with the POP term (A13: from the start).
        pop_stop_iter: first step without it.
        pop_views: "current" takes importance from the current view, "window" from all since densification (A1).
        pop_over: "all" averages over all Gaussians, "visible" over those the view shows (A12).
        lambda_entropy: weight of the mean binary entropy of all opacities, a rival of the POP term that does not ask
            what is important; on at the same steps.
    """

    lambda_pop: float = 1e-3
    pop_start_iter: int = 0
    pop_stop_iter: int = 15_000
    pop_views: Literal["current", "window"] = "current"
    pop_over: Literal["all", "visible"] = "all"
    lambda_entropy: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Objective:
    """What a render is compared with its photograph by: `(1 - lambda_ssim) pixel_scale pixelwise + lambda_ssim D-SSIM`.

    Attributes:
        pixelwise: name of the loss between pixels: "l2" for eq. 9, "l1" for eq. 2.
        pixel_scale: factor on that term (A10, A28).
        lambda_ssim: weight of D-SSIM; the rest, to 1, is the pixelwise term's.
        padding: of SSIM, "valid" as gsplat, "same" as Inria.
        d_ssim_halved: D-SSIM as (1 - SSIM) / 2 instead of 1 - SSIM (A11).
    """

    pixelwise: str = "l2"
    pixel_scale: float = 1.0
    lambda_ssim: float = 0.01
    padding: Padding = "valid"
    d_ssim_halved: bool = False

    @property
    def weights(self) -> tuple[float, float]:
        """Return what the pixelwise term and 1 - SSIM are multiplied by."""
        return (1.0 - self.lambda_ssim) * self.pixel_scale, self.lambda_ssim * (0.5 if self.d_ssim_halved else 1.0)

    def at(self, step: int, l2_stop_iter: int | None) -> Objective:
        """Return what a step minimises: eq. 2 with `LAMBDA_SSIM_3DGS` takes over where L2 stops, if it does (A20)."""
        if l2_stop_iter is None or step < l2_stop_iter:
            return self
        return replace(self, pixelwise="l1", lambda_ssim=LAMBDA_SSIM_3DGS)


@dataclass(frozen=True, kw_only=True)
class LearningRates:
    """Adam's learning rates (A21: none changes with the L2 loss); gsplat's trainer.

    Attributes:
        means: of the centres, in scene scales; decays log-linearly over the training.
        means_decay: what that rate is multiplied by from the first step to the last.
        scales: of the log scales.
        quats: of the quaternions.
        opacities: of the logits.
        sh0: of the harmonics' band 0.
        sh_rest: of the other bands.
        others_decay: what all rates but those of the centres and the opacities are multiplied by from the first step
            to the last; 1 in every published method.
        beta2: decay of Adam's second moments from one update to the next; 0.999 in every published method.
    """

    means: float = 1.6e-4
    means_decay: float = 0.01
    scales: float = 5e-3
    quats: float = 1e-3
    opacities: float = 5e-2
    sh0: float = 2.5e-3
    sh_rest: float = 2.5e-3 / 20.0
    others_decay: float = 1.0
    beta2: float = BETAS[1]

    def by_parameter(self) -> dict[str, float]:
        """List the rates under the names of the raw parameters; that of the means still in scene scales."""
        same = {name: getattr(self, name) for name in ("means", "scales", "quats", "opacities", "sh0")}
        return {**same, "shN": self.sh_rest}


@dataclass(frozen=True, kw_only=True)
class UpdateRules:
    """When Adam moves which parameter, and how its rates depart from one log-linear decay; the defaults are gsplat's.

    Attributes:
        edits_replace_update: a step after which Gaussians are added or removed moves nothing, as in Inria's loop, where
            the edit makes new tensors before Adam is asked; gsplat, since 1.5, moves first.
        sh_start_iter: step from which the degree of the harmonics is counted; before it is 0 (Mini-Splatting).
        sh_rest_every: the bands beyond the first move at steps that are multiples of it, step 0 excepted, by the sum of
            their gradients since the last one (Taming-3DGS).
        opacities_stop_iter: first step from which opacities stay as they are (Taming-3DGS); -1 never.
        means_rewind_iter: step from which the positions' rate is that of an earlier one (Mini-Splatting); 0 never.
        means_rewind_to: that earlier step.
        rounds_start_iter: first step of the rounds of pruning and refining that follow a training (PUP-3DGS), whose
            positions' rate starts each round where the training has ended; 0 none.
        round_steps: length of a round.
        round_decay: what all other rates are multiplied by within a round,
        round_decay_every: each so many steps.
    """

    edits_replace_update: bool = False
    sh_start_iter: int = 0
    sh_rest_every: int = 1
    opacities_stop_iter: int = -1
    means_rewind_iter: int = 0
    means_rewind_to: int = 0
    rounds_start_iter: int = 0
    round_steps: int = 5000
    round_decay: float = 0.95
    round_decay_every: int = 400


@dataclass(frozen=True, kw_only=True)
class AppearanceRates:
    """Adam's learning rates of what belongs to photographs and not to the scene; each decays log-linearly.

    Attributes:
        exposures: of the entries of every exposure; Inria's.
        exposures_decay: what that rate is multiplied by from the first step to the last.
        cameras: of the corrections of cameras, rad and world units; gsplat's.
        cameras_decay: likewise.
    """

    exposures: float = 1e-2
    exposures_decay: float = 0.1
    cameras: float = 1e-5
    cameras_decay: float = 0.01


APPEARANCE_RATES: Final = AppearanceRates()
POP: Final = DensityConfig()
GSPLAT: Final = DensityConfig(blur_stop_iter=-1, reset_every=3000, prune_too_big=True)
# whose opacities move half as fast since October 2024
INRIA_RATES: Final = LearningRates(opacities=0.025)


@dataclass(frozen=True, kw_only=True)
class Recipe(Objective, PopTerm):
    """What a training minimises, and its schedule; the defaults are POP's.

    Attributes:
        l2_stop_iter: step from which eq. 2 with `LAMBDA_SSIM_3DGS` takes over; None never, as only POP is said to stop
            (A20).
        density: of the Gaussians.
        lr: learning rates.
        max_steps: length of the training, over which the positions' learning rate decays.
        sh_interval: steps between two raises of the harmonics' degree.
        profile: of the renderer (A24).
        updates: when Adam moves what.
        adam_restarts: steps after which Adam begins anew, its moments zero: where all Gaussians are replaced.
        depth_lambda: weight of the disparities' error at the sparse points that a photograph sees, times the scene's
            scale; 0 leaves it out.
        opacity_reg: weight of the mean opacity; 0 leaves it out.
        scale_reg: weight of the mean scale, per world unit; 0 leaves it out.
    """

    l2_stop_iter: int | None = None
    density: DensityConfig = POP
    lr: LearningRates = LearningRates()
    max_steps: int = 30_000
    sh_interval: int = 1000
    profile: Profile = PAPER
    updates: UpdateRules = UpdateRules()
    adam_restarts: tuple[int, ...] = ()
    depth_lambda: float = 0.0
    opacity_reg: float = 0.0
    scale_reg: float = 0.0
