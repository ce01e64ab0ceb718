"""The 32 questions that the POP paper leaves open, as data: what is done here, what else can be chosen, and where.

`mark` is what to search for at the place named by `where`: the label itself, or the decision or output that settles the
question. Impact: "H" changes counts or PSNR visibly and is always switchable, "M" may, "L" does not matter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal


@dataclass(frozen=True)
class Ambiguity:
    """One open question.

    Attributes:
        id: "A1" to "A32".
        impact: "H", "M" or "L".
        question: what the paper does not say.
        default: what is done.
        where: "module:attribute" of the place that decides.
        alternatives: the other readings that can be chosen, each by the setting that chooses it.
        mark: found in the source of that place; the label itself unless given.
    """

    id: str
    impact: Literal["H", "M", "L"]
    question: str
    default: str
    where: str
    alternatives: tuple[str, ...] = ()
    mark: str = ""


_CONFIG: Final = "pop_ref.settings:DensityConfig"
_TERM: Final = "pop_ref.settings:PopTerm"
_PHOTOMETRIC: Final = "pop_ref.settings:Objective"
_RECIPE: Final = "pop_ref.settings:Recipe"
_RECIPES: Final = "pop_ref.recipes:RECIPES"

AMBIGUITIES: Final = (
    Ambiguity(
        "A1",
        "H",
        "Which Gaussians are important: by one view, or over several?",
        "what dominates a pixel of the current view",
        _TERM,
        ("Recipe.pop_views = window",),
    ),
    Ambiguity(
        "A2",
        "H",
        "Over what is a dominant count cumulative in the blur rule?",
        "over the pixels of the view that the densification step follows",
        _CONFIG,
        ("DensityConfig.blur_window = any_view", "DensityConfig.blur_window = sum"),
    ),
    Ambiguity(
        "A3",
        "M",
        "When do counts and flags start again?",
        "after every densification step, since rows change",
        "pop_ref.density:densify_and_prune",
    ),
    Ambiguity(
        "A4",
        "M",
        "Which Gaussian wins a pixel when two weights are equal?",
        "the splat in front",
        "pop_ref.dominance:dominant_id",
        mark="D8",
    ),
    Ambiguity(
        "A5",
        "L",
        "Which Gaussian wins a pixel that nothing covers?",
        "nobody: its dominant id is -1",
        "pop_ref.dominance:dominant_id",
        mark="none",
    ),
    Ambiguity(
        "A6",
        "L",
        "Do skipped and terminating splats compete for a pixel?",
        "no, only blended ones",
        "pop_ref.dominance:dominant_id",
        mark="only blended splats compete",
    ),
    Ambiguity("A7", "L", "What is a mean over no Gaussians?", "0, and no gradient", "pop_ref.polarization:pop_loss"),
    Ambiguity(
        "A8",
        "H",
        "Does gradient densification continue next to the blur rule?",
        "yes: the union is grown",
        _CONFIG,
        ("DensityConfig.grow_on_gradient_in_blur_window = False", "DensityConfig.grow_on_gradient = False"),
    ),
    Ambiguity(
        "A9",
        "H",
        "Is the gradient threshold tuned for the smaller gradients of L2?",
        "no, 2e-4 stays",
        _CONFIG,
        ("DensityConfig.grow_grad2d = 1e-4",),
    ),
    Ambiguity(
        "A10",
        "H",
        "What does L2 average over, and is there a 1/2?",
        "pixels and channels, no 1/2; as eq. 4",
        _PHOTOMETRIC,
        ("Recipe.pixel_scale = 0.5", "Recipe.pixel_scale = 3.0"),
    ),
    Ambiguity(
        "A11",
        "M",
        "Is D-SSIM 1 - SSIM or half of it?",
        "1 - SSIM, on whole windows",
        "pop_ref.ssim:d_ssim",
        ("Recipe.d_ssim_halved = True", "Recipe.padding = same"),
    ),
    Ambiguity(
        "A12",
        "H",
        "Does the POP loss sum over all Gaussians or over visible ones?",
        "over all, as eq. 8 prints",
        _TERM,
        ("Recipe.pop_over = visible",),
    ),
    Ambiguity(
        "A13",
        "M",
        "Is the POP loss on from the first step?",
        "yes, for steps 0 to 14999",
        _TERM,
        ("Recipe.pop_start_iter = 500",),
    ),
    Ambiguity(
        "A14",
        "H",
        "What of the blur set is cloned, and what is split?",
        "the gradient rule's size test decides",
        _CONFIG,
        ("DensityConfig.blur_rule = split",),
    ),
    Ambiguity(
        "A15", "M", "Under which opacity is a Gaussian pruned?", "0.005", _CONFIG, ("DensityConfig.prune_opa = 0.01",)
    ),
    Ambiguity(
        "A16",
        "H",
        "Are oversized Gaussians still pruned when there is no reset?",
        "no: as in gsplat, size pruning goes with resets",
        _CONFIG,
        ("DensityConfig.prune_too_big = True",),
    ),
    Ambiguity("A17", "L", "When is pruned, and until when?", "with each densification step, not after 15k", _CONFIG),
    Ambiguity("A18", "L", "Whose H and W are in the blur threshold?", "each view's own", "pop_ref.density:blur_set"),
    Ambiguity(
        "A19",
        "L",
        "Are both ends of the blur window in it?",
        "yes: 41 densification steps",
        "pop_ref.density:blurs_at",
        ("DensityConfig.blur_stop_iter = 6999",),
    ),
    Ambiguity(
        "A20",
        "H",
        "Does the L2 loss stay after 15k?",
        "yes, only POP is said to end",
        "pop_ref.settings:Recipe",
        ("Recipe.l2_stop_iter = 15000",),
    ),
    Ambiguity("A21", "L", "Do learning rates change with the L2 loss?", "no", "pop_ref.optimizer:learning_rates"),
    Ambiguity(
        "A22",
        "H",
        "What is the reset row of the opacity ablation?",
        "L2 and blur, no POP, four resets to 0.01",
        _RECIPES,
        ("Recipe.lambda_pop = 0.0", "DensityConfig.reset_every = 3000"),
    ),
    Ambiguity(
        "A23",
        "M",
        "What divides the sum of gradients in eq. 3?",
        "the views that showed the Gaussian",
        "pop_ref.density:average_grads",
        ("DensityConfig.grad_denominator = window",),
    ),
    Ambiguity(
        "A24",
        "M",
        "Which version of gsplat, hence which constants?",
        "1.5: alpha up to 0.999",
        _RECIPE,
        ("Recipe.profile = gsplat_1_6", "Recipe.profile = inria"),
    ),
    Ambiguity(
        "A25",
        "M",
        "Are opacities reset at step 0, as gsplat 1.1 to 1.5.2 does?",
        "no, in no row: as gsplat's main since August 2025",
        "pop_ref.density:resets_at",
        ("DensityConfig.reset_at_zero = True",),
    ),
    Ambiguity(
        "A26",
        "M",
        "Which opacity do split children get?",
        "their parent's",
        "pop_ref.density_rows:split_rows",
        ("DensityConfig.revised_opacity = True",),
    ),
    Ambiguity(
        "A27",
        "L",
        "Are dominant counts taken before or after the update?",
        "in the forward pass of the loss",
        "pop_ref.training:look",
    ),
    Ambiguity(
        "A28",
        "M",
        'What is "div = n" in the comparison of L1 and L2?',
        "L1 / n with an unchanged D-SSIM, n from 1 to 100",
        "pop_ref.recipes:L1_DIVIDED",
        ("Recipe.lambda_ssim = 0.0",),
    ),
    Ambiguity(
        "A29",
        "H",
        'What is in the row "L2" of the module ablation?',
        "L2 and D-SSIM; no blur, POP or reset",
        _RECIPES,
        ("DensityConfig.blur_stop_iter = -1", "Recipe.lambda_pop = 0.0"),
    ),
    Ambiguity(
        "A30",
        "L",
        "What is a Gaussian processed per pixel?",
        "both counts are kept: blended, and traversed",
        "pop_ref.records:Render",
        mark="n_traversed",
    ),
    Ambiguity(
        "A31",
        "M",
        "Which network is the LPIPS of each row?",
        "each variant is reported under its own name",
        "pop_fast.train.lpips:VARIANTS",
        mark="alex_norm",
    ),
    Ambiguity(
        "A32",
        "H",
        "Which images: those the data set brings shrunk, or shrunk anew?",
        "those it brings",
        "pop_fast.data.load:load_capture",
        ("load_capture.images = images", "load_capture.resize = bicubic"),
        mark="images_<factor>",
    ),
)
