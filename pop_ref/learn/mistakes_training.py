"""Mistakes that everyone makes once, from losses to the loop; see `mistakes`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np

from pop_ref.learn.mistakes_geometry import Known
from pop_ref.learn.probes import Oracle


def _reordered(rows: Any, order: Any) -> Any:
    return type(rows)(*({name: x[order] for name, x in each.items()} for each in (rows.params, rows.m, rows.v)))


def _clones_first(o: Oracle, rows: Any, mask: Any) -> Any:
    """Make `clone_rows` with the copies before all others."""
    return _reordered(o["clone_rows"](rows, mask), np.roll(np.arange(len(mask) + np.sum(mask)), int(np.sum(mask))))


def _clone_with_moments(m: bool = True, v: bool = True) -> Callable[..., Any]:
    """Make `clone_rows` whose copies have moments of their sources."""

    def made(o: Oracle, rows: Any, mask: Any) -> Any:
        cloned = o["clone_rows"](rows, mask)
        with_m, with_v = ({k: np.concatenate([x, x[mask]]) for k, x in each.items()} for each in (rows.m, rows.v))
        return type(rows)(cloned.params, with_m if m else cloned.m, with_v if v else cloned.v)

    return made


def _over_pixels(name: str) -> Known:
    return {
        "You divide by the number of pixels; the mean is over the pixels and their channels.": (
            "Divide by H W D, three times as much for a picture with three channels.",
            lambda o, image, *given: o[name](image, *given) * image.shape[2],
        )
    }


_DIVIDED: Final = "max(«int(np.sum(important))→len(mask)», 1) ... max(«int(np.sum(other))→len(mask)», 1)"

TRAINING: Final[dict[str, Known]] = {
    "l1": {
        **_over_pixels("l1"),
        "You square the difference: that is L2; L1 takes its absolute value.": (
            "The mean of |image - target|.",
            lambda o, *given: o["l2"](*given),
        ),
        "The absolute value is missing: differences of either sign cancel.": (
            "The mean of |image - target|.",
            "np.sum(«np.abs(difference)→difference»)",
        ),
    },
    "l1_vjp": {
        **_over_pixels("l1_vjp"),
        "You pass the difference on; the derivative of |x| is the sign of x, whatever its size.": (
            "v sign(image - target) over the number of entries.",
            lambda o, *given: 0.5 * o["l2_vjp"](*given),
        ),
    },
    "l2": _over_pixels("l2"),
    "l2_vjp": {
        "A two is missing: the derivative of a square is twice its base.": (
            "l2 is a mean of squares, without a half in front.",
            lambda o, *given: 0.5 * o["l2_vjp"](*given),
        ),
        **_over_pixels("l2_vjp"),
    },
    "pop_loss": {
        "The poles are exchanged: important Gaussians are drawn to opacity 1, the others to 0.": (
            "The mean of 1 - o where the mask is true, plus the mean of o where it is not.",
            "np.sum(«1.0 - →»opacities[important]) ... np.sum(«→1.0 - »opacities[other])",
        ),
        "Both sides are divided by the number of all Gaussians: the important have a mean of their own, and so have"
        " the others.": (
            "Divide the first sum by N_imp and the second by N - N_imp.",
            _DIVIDED,
        ),
        **{
            f"The mean over the {others} is missing: the prior has two, and each is over its own Gaussians.": (
                "The mean of 1 - o where the mask is true, plus the mean of o where it is not.",
                f"float({change})",
            )
            for others, change in (
                ("unimportant", "toward_one« + toward_zero→»"),
                ("important", "«toward_one + →»toward_zero"),
            )
        },
    },
    "pop_loss_vjp": {
        "The poles are exchanged: the loss falls where important opacities rise and the others fall.": (
            "-v_loss / N_imp where the mask is true, v_loss / (N - N_imp) where it is not.",
            lambda o, opacities, mask, v_loss, *visible: -o["pop_loss_vjp"](opacities, mask, v_loss, *visible),
        ),
        "Both sides are divided by the number of all Gaussians: the important have a mean of their own, and so have"
        " the others.": (
            "Divide the first sum by N_imp and the second by N - N_imp.",
            _DIVIDED,
        ),
        "The important are divided by the number of all Gaussians; their mean is over themselves.": (
            "-v_loss / N_imp where the mask is true.",
            "max(«int(np.sum(important))→len(mask)», 1)",
        ),
    },
    "adam_step": {
        "The two running means are not corrected: both start at 0, so that the first steps have the wrong length.": (
            "Divide m by 1 - beta1^t and v by 1 - beta2^t before the quotient; keep m and v themselves as they are.",
            "np.sqrt(new_v[name])« / np.sqrt(1.0 - beta2**t)→» ... lr[name]« / (1.0 - beta1**t)→» *",
        ),
        "The number of the update is one too many: `step` is 1 for the first one already.": (
            "Correct with beta^step.",
            "numbers[name]«→ + 1»",
        ),
        "The number of the update is one too few: `step` is 1 for the first one already.": (
            "Correct with beta^step.",
            "numbers[name]«→ - 1» ... "
            "«lr[name] / (1.0 - beta1**t) * new_m[name]→lr[name] * new_m[name] / (1.0 - beta1**t)»",
        ),
        "The two betas are exchanged: the first decays the mean of gradients, the second that of their squares.": (
            "m = beta1 m + (1 - beta1) g, v = beta2 v + (1 - beta2) g^2.",
            "beta1, beta2 = betas«→[::-1]»",
        ),
        "v averages the gradient itself; it is the running mean of its square.": (
            "v = beta2 v + (1 - beta2) g^2.",
            "(1.0 - beta2) * g« * g→»",
        ),
        "The root is missing: v is a mean of squares, and the step is divided by a length.": (
            "x - lr m / (sqrt(v) + eps), both corrected.",
            "denominator = «np.sqrt(new_v[name]) / np.sqrt(1.0 - beta2**t)→new_v[name] / (1.0 - beta2**t)»",
        ),
        "You go up the loss: the gradient points to where the loss rises, so a step is taken against it.": (
            "x - lr m / sqrt(v), with a minus.",
            "params[name] «-→+» lr",
        ),
        "The running mean m is not divided by 1 - beta1^t: it starts at 0, so that the first steps are too short.": (
            "Divide for the quotient only; what is kept and returned is m itself.",
            "lr[name]« / (1.0 - beta1**t)→» *",
        ),
        "The running mean v is not divided by 1 - beta2^t: it starts at 0, so that the first steps are too long.": (
            "Divide for the quotient only; what is kept and returned is v itself.",
            "np.sqrt(new_v[name])« / np.sqrt(1.0 - beta2**t)→»",
        ),
        "The factor 1 - beta1 is missing before the gradient: m would be a sum and no mean.": (
            "m = beta1 m + (1 - beta1) g.",
            "m[name] + «(1.0 - beta1) * (g - m[name])→g - (1.0 - beta1) * m[name]»",
        ),
        "The step is made of this gradient alone; it is made of the running mean m.": (
            "x - lr m / (sqrt(v) + eps), both corrected.",
            "«lr[name] / (1.0 - beta1**t) * new_m[name]→lr[name] * g»",
        ),
        "You take the root before the correction: v is divided by 1 - beta2^t first.": (
            "sqrt(v / (1 - beta2^t)) + eps.",
            "np.sqrt(new_v[name]) / «np.sqrt(1.0 - beta2**t)→(1.0 - beta2**t)»",
        ),
    },
    "clone_rows": {
        "The copies stand before their sources; they are appended at the end.": (
            "np.concatenate([rows, copies]), in the parameters and both moments.",
            _clones_first,
        ),
        **{
            f"The copies have {of} of their sources: newcomers start with moments of 0.": (
                "Append copies to the parameters, and zeros to m and v.",
                _clone_with_moments(*which),
            )
            for which, of in (
                ((True, True), "Adam's moments"),
                ((True, False), "Adam's first moments, m,"),
                ((False, True), "Adam's second moments, v,"),
            )
        },
    },
    "split_rows": {
        "The widths of the children are kept as they are; what is stored are their logarithms.": (
            "log s' = log(s / 1.6).",
            "np.concatenate([«np.log(scales / SPLIT_SHRINK)→scales / SPLIT_SHRINK»]",
        ),
        "The children are as wide as their parent; each is narrower by a factor of 1.6.": (
            "log s' = log s - log 1.6.",
            "np.log(scales« / SPLIT_SHRINK→»)",
        ),
        "The two children of a parent stand side by side; all first children come before all second ones.": (
            "Append the children of normals[0], then those of normals[1].",
            "«np.concatenate([array] * SPLIT_CHILDREN)→np.repeat(array, SPLIT_CHILDREN, axis=0)» ... "
            "[«child * n_split + i→i * SPLIT_CHILDREN + child»] ... "
            "= np.«concatenate([np.log(scales / SPLIT_SHRINK)] *→repeat(np.log(scales / SPLIT_SHRINK),» SPLIT_CHILDREN"
            "«→, axis=0»)\n    if",
        ),
        "The parents stay; a split puts two children in the place of one parent.": (
            "Keep the rows that were not selected, rows[~mask], and append both kinds of children.",
            "_keep_and_append(rows, «~mask→np.ones(len(rows), dtype=bool)», children)",
        ),
        "The draws are not turned: the children must lie along the parent's own axes.": (
            "mean + R(q) (s * eps): scale each draw first, then turn it.",
            "«rotmats[i] @ (→»scales[i] * normals[child, i]«)→»",
        ),
        "You divide the logarithms of the widths by 1.6: to divide a width by 1.6, subtract log 1.6.": (
            "params['scales'] holds logarithms: np.log(np.exp(scales) / 1.6).",
            '[«np.log(scales / SPLIT_SHRINK)→parents["scales"] / SPLIT_SHRINK»]',
        ),
        "You subtract 1.6 from the logarithms of the widths: to divide a width by 1.6, subtract log 1.6.": (
            "params['scales'] holds logarithms.",
            '[«np.log(scales / SPLIT_SHRINK)→parents["scales"] - SPLIT_SHRINK»]',
        ),
        "The draws are not scaled: a child lies as far from its parent's centre as the parent is wide.": (
            "mean + R(q) (s * eps): scale each draw first, then turn it.",
            "rotmats[i] @ «(scales[i] * normals[child, i])→normals[child, i]»",
        ),
    },
    "prune_rows": {
        "You keep the rows that are to be removed: the mask selects what goes.": (
            "rows[~mask] are the survivors, in every parameter and both moments.",
            lambda o, rows, mask: o["prune_rows"](rows, ~mask),
        ),
    },
    "grow_masks": {
        "The share grow_scale3d is missing: small is at most that share of the scene's scale.": (
            "scales.max(axis=1) <= config.grow_scale3d * scene_scale.",
            "<= «config.grow_scale3d * →»scene_scale",
        ),
        "You compare the smallest of the three widths: a Gaussian is small if its largest one is.": (
            "scales.max(axis=1).",
            "np.«max→min»(scales, axis=1)",
        ),
        "You compare the sum of the gradients; their average over the views that showed the Gaussian is asked for.": (
            "average_grads(statistics) divides, and knows what no view showed.",
            lambda o, window, *given: o["grow_masks"](
                replace(window, n_visible=np.minimum(window.n_visible, 1)), *given
            ),
        ),
        "The scale of the scene is missing: small is at most grow_scale3d times scene_scale.": (
            "scales.max(axis=1) <= config.grow_scale3d * scene_scale.",
            "config.grow_scale3d« * scene_scale→»",
        ),
        "You compare the mean of the three widths: a Gaussian is small if its largest one is.": (
            "scales.max(axis=1).",
            "np.«max→mean»(scales, axis=1)",
        ),
    },
    "params_vjp": {
        "The gradient of the widths is not pulled back to their logarithms.": (
            "scales_from_log_scales_vjp(params['scales'], gradients.scales).",
            '«scales_from_log_scales_vjp(params["scales"], gradients.scales)→gradients.scales»',
        ),
        "The gradient of the opacities is not pulled back to their logits.": (
            "opacities_from_logits_vjp(params['opacities'], gradients.opacities + v_opacities).",
            '"opacities": «opacities_from_logits_vjp(params["opacities"], →»gradients.opacities + v_opacities«)→»,',
        ),
        "The prior's pull is missing: v_opacities is added to the gradient of the render's opacities.": (
            "gradients.opacities + v_opacities, then back through the sigmoid.",
            "gradients.opacities« + v_opacities→»",
        ),
    },
    "train_step": {
        "The step is not counted: the new state has the number of the old one.": (
            "Training(..., step=state.step + 1, ...).",
            "step« + 1→», waiting)",
        ),
    },
}
