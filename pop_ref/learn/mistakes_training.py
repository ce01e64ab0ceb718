"""Mistakes that everyone makes once, from losses to the loop; see `mistakes`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from pop_ref.density import POP
from pop_ref.learn.mistakes_geometry import Known
from pop_ref.learn.probes import Oracle
from pop_ref.optimizer import BETAS, EPS


def _adam(
    first: bool = True, second: bool = True, sign: float = -1.0, late: int = 0, squared: bool = True, root: bool = True,
    turned: bool = False, share: bool = True, of_gradient: bool = False, late_share: bool = False,
) -> Callable[..., Any]:  # fmt: skip
    """Make `adam_step` without the division by 1 - beta1^t or by 1 - beta2^t, uphill, with another number of the
    update, with g for g^2, without the root, with its betas exchanged, without 1 - beta1, with g in m's place,
    or with the root taken before the correction."""

    def made(o: Oracle, params: Any, grads: Any, m: Any, v: Any, step: Any, lr: Any,
             betas: Any = BETAS, eps: float = EPS) -> Any:  # fmt: skip
        params, m, v = dict(params), dict(m), dict(v)
        betas = betas[::-1] if turned else betas
        for name, g in grads.items():
            t = (step if isinstance(step, int) else step[name]) + late
            m[name] = betas[0] * m[name] + (1.0 - betas[0] if share else 1.0) * g
            v[name] = betas[1] * v[name] + (1.0 - betas[1]) * (g * g if squared else g)
            mean = m[name] / (1.0 - betas[0] ** t if first else 1.0)
            mean = g if of_gradient else mean
            size = v[name] / (1.0 - betas[1] ** t if second else 1.0)
            size = (np.sqrt(size) if root else size) + eps
            size = np.sqrt(v[name]) / (1.0 - betas[1] ** t) + eps if late_share else size
            params[name] = params[name] + sign * lr[name] * mean / size
        return params, m, v

    return made


def _means(of_all: bool = False, turned: bool = False, sides: Sequence[bool] = (True, False)) -> Callable[..., Any]:
    """Make `pop_loss` with both sums divided by the number of all, with exchanged poles, or with one of its means."""

    def made(o: Oracle, opacities: Any, mask: Any, visible: Any = None) -> float:
        part = np.ones(len(mask), dtype=bool) if visible is None else visible
        total = 0.0
        for important in sides:
            side = part & (mask if important else ~mask)
            apart = 1.0 - opacities if important != turned else opacities
            total += float(np.sum(apart[side])) / max(len(mask) if of_all else int(np.sum(side)), 1)
        return total

    return made


def _signed_mean(o: Oracle, image: Any, target: Any, mask: Any = None) -> float:
    """Make `l1` without its absolute value."""
    difference = image - target if mask is None else (image - target)[mask]
    return float(np.sum(difference)) / max(difference.size, 1)


def _reordered(rows: Any, order: Any) -> Any:
    return type(rows)(*({name: x[order] for name, x in each.items()} for each in (rows.params, rows.m, rows.v)))


def _split_in_pairs(o: Oracle, rows: Any, mask: Any, *given: Any) -> Any:
    """Make `split_rows` with the two children of a parent one after the other."""
    n, k = int(np.sum(~mask)), int(np.sum(mask))
    pairs = n + np.arange(2 * k).reshape(2, k).T.ravel()
    return _reordered(o["split_rows"](rows, mask, *given), np.concatenate([np.arange(n), pairs]))


def _clones_first(o: Oracle, rows: Any, mask: Any) -> Any:
    """Make `clone_rows` with the copies before all others."""
    return _reordered(o["clone_rows"](rows, mask), np.roll(np.arange(len(mask) + np.sum(mask)), int(np.sum(mask))))


def _split_beside(o: Oracle, rows: Any, mask: Any, normals: Any, *revised: Any) -> Any:
    """Make `split_rows` that keeps the parents."""
    kept = o["split_rows"](rows, mask, normals, *revised)
    n = int(np.sum(~mask))

    def both(old: Any, new: Any) -> Any:
        return {name: np.concatenate([old[name], new[name][n:]]) for name in old}

    return type(kept)(both(rows.params, kept.params), both(rows.m, kept.m), both(rows.v, kept.v))


def _split_otherwise(name: str, change: Callable[[Any], Any], to: str) -> Callable[..., Any]:
    """Make `split_rows` that reads a parameter changed, and takes another parameter of the children from that."""

    def made(o: Oracle, rows: Any, mask: Any, normals: Any, *revised: Any) -> Any:
        changed = type(rows)({**rows.params, name: change(rows.params[name])}, rows.m, rows.v)
        split, other = (o["split_rows"](each, mask, normals, *revised) for each in (rows, changed))
        n = int(np.sum(~mask))
        taken = np.concatenate([split.params[to][:n], other.params[to][n:]])
        return type(split)({**split.params, to: taken}, split.m, split.v)

    return made


def _unturned(o: Oracle, rows: Any, mask: Any, normals: Any, *revised: Any) -> Any:
    """Make `split_rows` that draws children along the world's axes."""
    upright = {**rows.params, "quats": np.tile([1.0, 0.0, 0.0, 0.0], (len(mask), 1))}
    split = o["split_rows"](type(rows)(upright, rows.m, rows.v), mask, normals, *revised)
    quats = o["split_rows"](rows, mask, normals, *revised).params["quats"]
    return type(split)({**split.params, "quats": quats}, split.m, split.v)


def _clone_with_moments(m: bool = True, v: bool = True) -> Callable[..., Any]:
    """Make `clone_rows` whose copies have moments of their sources."""

    def made(o: Oracle, rows: Any, mask: Any) -> Any:
        cloned = o["clone_rows"](rows, mask)
        with_m, with_v = ({k: np.concatenate([x, x[mask]]) for k, x in each.items()} for each in (rows.m, rows.v))
        return type(rows)(cloned.params, with_m if m else cloned.m, with_v if v else cloned.v)

    return made


def _uncounted(o: Oracle, state: Any, *given: Any) -> Any:
    """Make `train_step` whose new state has the old one's number."""
    after, loss = o["train_step"](state, *given)
    return replace(after, step=state.step), loss


def _over_all(o: Oracle, opacities: Any, mask: Any, v_loss: float, visible: Any = None) -> Any:
    """Make `pop_loss_vjp` whose sides are both divided by the number of all Gaussians."""
    part = np.ones(len(mask), dtype=bool) if visible is None else visible
    return v_loss * np.where(part, np.where(mask, -1.0, 1.0), 0.0) / len(mask)


def _over_pixels(name: str) -> Known:
    return {
        "You divide by the number of pixels; the mean is over the pixels and their channels.": (
            "Divide by H W D, three times as much for a picture with three channels.",
            lambda o, image, *given: o[name](image, *given) * image.shape[2],
        )
    }


TRAINING: Final[dict[str, Known]] = {
    "l1": {
        **_over_pixels("l1"),
        "You square the difference: that is L2; L1 takes its absolute value.": (
            "The mean of |image - target|.",
            lambda o, *given: o["l2"](*given),
        ),
        "The absolute value is missing: differences of either sign cancel.": (
            "The mean of |image - target|.",
            _signed_mean,
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
            _means(turned=True),
        ),
        "Both sides are divided by the number of all Gaussians: the important have a mean of their own, and so have"
        " the others.": (
            "Divide the first sum by N_imp and the second by N - N_imp.",
            _means(of_all=True),
        ),
        **{
            f"The mean over the {others} is missing: the prior has two, and each is over its own Gaussians.": (
                "The mean of 1 - o where the mask is true, plus the mean of o where it is not.",
                _means(sides=[important]),
            )
            for important, others in ((True, "unimportant"), (False, "important"))
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
            _over_all,
        ),
        "The important are divided by the number of all Gaussians; their mean is over themselves.": (
            "-v_loss / N_imp where the mask is true.",
            lambda o, opacities, mask, v_loss, *visible: np.where(
                mask & o["pop_loss_vjp"](opacities, mask, v_loss, *visible).astype(bool),
                -v_loss / max(len(opacities), 1),
                o["pop_loss_vjp"](opacities, mask, v_loss, *visible),
            ),
        ),
    },
    "adam_step": {
        "The two running means are not corrected: both start at 0, so that the first steps have the wrong length.": (
            "Divide m by 1 - beta1^t and v by 1 - beta2^t before the quotient; keep m and v themselves as they are.",
            _adam(first=False, second=False),
        ),
        "The number of the update is one too many: `step` is 1 for the first one already.": (
            "Correct with beta^step.",
            _adam(late=1),
        ),
        "The number of the update is one too few: `step` is 1 for the first one already.": (
            "Correct with beta^step.",
            _adam(late=-1),
        ),
        "The two betas are exchanged: the first decays the mean of gradients, the second that of their squares.": (
            "m = beta1 m + (1 - beta1) g, v = beta2 v + (1 - beta2) g^2.",
            _adam(turned=True),
        ),
        "v averages the gradient itself; it is the running mean of its square.": (
            "v = beta2 v + (1 - beta2) g^2.",
            _adam(squared=False),
        ),
        "The root is missing: v is a mean of squares, and the step is divided by a length.": (
            "x - lr m / (sqrt(v) + eps), both corrected.",
            _adam(root=False),
        ),
        "You go up the loss: the gradient points to where the loss rises, so a step is taken against it.": (
            "x - lr m / sqrt(v), with a minus.",
            _adam(sign=1.0),
        ),
        "The running mean m is not divided by 1 - beta1^t: it starts at 0, so that the first steps are too short.": (
            "Divide for the quotient only; what is kept and returned is m itself.",
            _adam(first=False),
        ),
        "The running mean v is not divided by 1 - beta2^t: it starts at 0, so that the first steps are too long.": (
            "Divide for the quotient only; what is kept and returned is v itself.",
            _adam(second=False),
        ),
        "The factor 1 - beta1 is missing before the gradient: m would be a sum and no mean.": (
            "m = beta1 m + (1 - beta1) g.",
            _adam(share=False),
        ),
        "The step is made of this gradient alone; it is made of the running mean m.": (
            "x - lr m / (sqrt(v) + eps), both corrected.",
            _adam(of_gradient=True),
        ),
        "You take the root before the correction: v is divided by 1 - beta2^t first.": (
            "sqrt(v / (1 - beta2^t)) + eps.",
            _adam(late_share=True),
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
            _split_otherwise("scales", lambda x: np.exp(x) / 1.6 + np.log(1.6), "scales"),
        ),
        "The children are as wide as their parent; each is narrower by a factor of 1.6.": (
            "log s' = log s - log 1.6.",
            _split_otherwise("scales", lambda x: x + np.log(1.6), "scales"),
        ),
        "The two children of a parent stand side by side; all first children come before all second ones.": (
            "Append the children of normals[0], then those of normals[1].",
            _split_in_pairs,
        ),
        "The parents stay; a split puts two children in the place of one parent.": (
            "Keep the rows that were not selected, rows[~mask], and append both kinds of children.",
            _split_beside,
        ),
        "The draws are not turned: the children must lie along the parent's own axes.": (
            "mean + R(q) (s * eps): scale each draw first, then turn it.",
            _unturned,
        ),
        "You divide the logarithms of the widths by 1.6: to divide a width by 1.6, subtract log 1.6.": (
            "params['scales'] holds logarithms: np.log(np.exp(scales) / 1.6).",
            _split_otherwise("scales", lambda x: x / 1.6 + np.log(1.6), "scales"),
        ),
        "You subtract 1.6 from the logarithms of the widths: to divide a width by 1.6, subtract log 1.6.": (
            "params['scales'] holds logarithms.",
            _split_otherwise("scales", lambda x: x + np.log(1.6) - 1.6, "scales"),
        ),
        "The draws are not scaled: a child lies as far from its parent's centre as the parent is wide.": (
            "mean + R(q) (s * eps): scale each draw first, then turn it.",
            _split_otherwise("scales", np.zeros_like, "means"),
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
            lambda o, window, scales, scene_scale, step, config=POP: o["grow_masks"](
                window, scales, scene_scale / config.grow_scale3d, step, config
            ),
        ),
        "You compare the smallest of the three widths: a Gaussian is small if its largest one is.": (
            "scales.max(axis=1).",
            lambda o, window, scales, *given: o["grow_masks"](
                window, np.repeat(scales.min(axis=1, keepdims=True), 3, axis=1), *given
            ),
        ),
        "You compare the sum of the gradients; their average over the views that showed the Gaussian is asked for.": (
            "average_grads(statistics) divides, and knows what no view showed.",
            lambda o, window, *given: o["grow_masks"](
                replace(window, n_visible=np.minimum(window.n_visible, 1)), *given
            ),
        ),
        "The scale of the scene is missing: small is at most grow_scale3d times scene_scale.": (
            "scales.max(axis=1) <= config.grow_scale3d * scene_scale.",
            lambda o, window, scales, scene_scale, *given: o["grow_masks"](window, scales, 1.0, *given),
        ),
        "You compare the mean of the three widths: a Gaussian is small if its largest one is.": (
            "scales.max(axis=1).",
            lambda o, window, scales, *given: o["grow_masks"](
                window, np.repeat(scales.mean(axis=1, keepdims=True), 3, axis=1), *given
            ),
        ),
    },
    "params_vjp": {
        "The gradient of the widths is not pulled back to their logarithms.": (
            "scales_from_log_scales_vjp(params['scales'], gradients.scales).",
            lambda o, params, gradients, v_opacities: {
                **o["params_vjp"](params, gradients, v_opacities),
                "scales": gradients.scales,
            },
        ),
        "The gradient of the opacities is not pulled back to their logits.": (
            "opacities_from_logits_vjp(params['opacities'], gradients.opacities + v_opacities).",
            lambda o, params, gradients, v_opacities: {
                **o["params_vjp"](params, gradients, v_opacities),
                "opacities": gradients.opacities + v_opacities,
            },
        ),
        "The prior's pull is missing: v_opacities is added to the gradient of the render's opacities.": (
            "gradients.opacities + v_opacities, then back through the sigmoid.",
            lambda o, params, gradients, v_opacities: o["params_vjp"](params, gradients, np.zeros_like(v_opacities)),
        ),
    },
    "train_step": {
        "The step is not counted: the new state has the number of the old one.": (
            "Training(..., step=state.step + 1, ...).",
            _uncounted,
        ),
    },
}
