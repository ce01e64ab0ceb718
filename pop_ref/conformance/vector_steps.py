"""Portable vectors of whole steps on photographs: render, loss, gradients, Adam, and what the method does to the rows.

Every step begins with Gaussians and moments that the vector holds, so that one that is wrong spoils no later one, and
each is judged as the laws of whole steps judge it. What a step carries on besides (statistics of a window, gradients
that wait) is its own. The settings below are those of the laws, which try further ones.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from typing import Any, Final

import numpy as np

from pop_ref.conformance import tolerances
from pop_ref.conformance.scenes import in_precision
from pop_ref.conformance.short_training import PLACE, OracleSteps, ShortTraining, WantedStep
from pop_ref.conformance.vector_check import axes, close, entry, equal, output
from pop_ref.conformance.vector_training import HeldDraws, KeptDraws, Vector
from pop_ref.conformance.views import gaussians, raw_params
from pop_ref.constants import Profile
from pop_ref.density import Rows
from pop_ref.methods import KEYS, RECIPE_OF, method_settings
from pop_ref.records import Camera
from pop_ref.settings import LearningRates

# no step of these changes the Gaussians
STILL: Final[dict[str, Any]] = {"refine_start_iter": 100, "reset_every": 0}
SHORT: Final[dict[str, Any]] = {"max_steps": 8, "sh_interval": 2}
# so slow that what rounding does not decide at the first step it decides at no later one
SLOW: Final = LearningRates(means=2e-5, scales=5e-4, quats=1e-4, opacities=5e-3, sh0=2.5e-4, sh_rest=1.25e-5)
FIRST: Final[dict[str, Any]] = {"pop_stop_iter": 3, "lambda_pop": 0.5, "pop_views": "window"}
_SECOND: Final = {"pop_start_iter": 1, "pop_stop_iter": 3, "lambda_pop": 0.0, "lambda_entropy": 0.5}
_HALVED: Final = {"lambda_ssim": 0.25, "d_ssim_halved": True, "padding": "same", "l2_stop_iter": 3}
# without red, as a green screen: what reads one channel alone takes it for black
_BEHIND: Final = (0.0, 0.5, 0.0)
ORDER: Final = (0, 1, 0, 1, 0)

PRIOR: Final = ShortTraining(
    "pop", {**STILL, **FIRST}, {**SHORT, **_HALVED, "lr": SLOW}, ORDER, seed=125, scene_scale=4.0
)
ENTROPY: Final = ShortTraining(
    "pop",
    {**STILL, **_SECOND},
    {**SHORT, "pixel_scale": 0.25, "l2_stop_iter": 3, "lr": SLOW},
    ORDER,
    seed=16,
    antialiased=True,
)
MASKED: Final = ShortTraining(
    "pop",
    {**STILL, "lambda_pop": 0.5, "pop_over": "visible"},
    {**SHORT, "pixelwise": "l1", "lambda_ssim": 0.25},
    ORDER[:3],
    seed=195,
    masked=True,
    background=_BEHIND,
)
# another Gaussian is important in either view
WINDOW: Final = replace(PRIOR, order=(0, 1), seed=1216, count=9)
# visible Gaussians dominate no pixel
HIDDEN: Final = replace(MASKED, order=(0,), seed=40)
# several tiles, and more rows of pixels than the compiled engine takes in one part, which is 16
LARGE: Final = [replace(short, size=(21, 37), order=(0,), count=9, seed=1078) for short in (PRIOR, MASKED)]
# a splat lies over two rows of tiles and does not reach their first column
ASIDE: Final = replace(MASKED, size=(40, 37), order=(0,), count=9, seed=2117)
# no window has a centre that counts
UNSEEN: Final = replace(MASKED, order=(0,), seed=3071)
# every parameter waits, rests, or goes back at a step of its own
WAITING: Final = ShortTraining(
    "pop",
    {**STILL, "sh_start_iter": 1, "sh_rest_every": 3, "opacities_stop_iter": 3},
    {"max_steps": 8, "sh_interval": 1, "lr": SLOW},
    (*ORDER, 1),
    seed=126,
)
# of some the bands beyond the first wait while others are pruned
OUTLASTED: Final = replace(WAITING, settings={**WAITING.settings, "final_prune_iter": 2, "final_prune_opa": 0.6})
# all bands, drawn one after the other, and no band but the first
BANDS: Final = [replace(WAITING, degree=3, seed=10), replace(PRIOR, degree=0, seed=6, order=(0, 1, 0))]
_GROWS: Final = {
    "refine_start_iter": 1, "refine_every": 2, "grow_grad2d": 1e-6, "grow_scale3d": 100.0, "prune_opa": 0.0
}  # fmt: skip
_REWOUND: Final = {"means_rewind_iter": 3, "means_rewind_to": 1, "edits_replace_update": True}
REWOUND: Final = ShortTraining(
    "pop", {**_GROWS, **_REWOUND}, {**SHORT, "lr": replace(SLOW, others_decay=0.125)}, ORDER[:4], seed=40
)
# large and faint are told apart by far, so that rounding decides nothing
CHANGES: Final[dict[str, Any]] = {
    "refine_start_iter": 0,
    "refine_stop_iter": 4,
    "refine_every": 2,
    "grow_grad2d": 1e-6,
    "grow_scale3d": 0.45,
    "prune_opa": 0.3,
    "prune_scale3d": 2.0,
    "prune_too_big_after": 0,
    "reset_every": 2,
    "reset_opa": 0.2,
}
CHANGED: Final = ShortTraining("gsplat", CHANGES, SHORT, ORDER[:4], seed=173, scene_scale=2.0)
_BLUR: Final = {"reset_every": 0, "theta_blur": 0.05, "blur_start_iter": 0, "blur_stop_iter": 3, "prune_opa": 0.05}
_LAST: Final = {"final_prune_iter": 2, "final_prune_opa": 0.6}
BLURRED: Final = replace(CHANGED, method="pop", settings={**CHANGES, **_BLUR, **_LAST}, seed=34, order=ORDER[:3])
_BLURRED_INSIDE: Final = replace(
    BLURRED,
    settings={**BLURRED.settings, "theta_blur": 0.3, "grow_grad2d": 1e3, "final_prune_iter": -1},
    seed=90,
    masked=True,
)
_OTHER_RATES: Final = replace(SLOW, means_decay=0.5, others_decay=0.125, beta2=0.75)
# whoever halved the gradients of two views, or collected one alone, would grow others
_TWO_GROW: Final = {**CHANGES, "reset_every": 0, "prune_scale3d": 100.0, "prune_opa": 0.01, "grow_grad2d": 0.0126}
BATCHES: Final = [
    replace(PRIOR, batch=2, order=(0, 1)),
    replace(CHANGED, batch=2, order=(0, 1) * 3, seed=202, settings=_TWO_GROW),
]
_TERMS: Final = {**SHORT, "depth_lambda": 0.5, "opacity_reg": 0.25, "scale_reg": 0.125}
FEW: Final = ShortTraining("pop", STILL, _TERMS, ORDER[:2], seed=34, sparse=18, scene_scale=4.0)
# scores of who goes and who stays are apart, and others would go by those of other photographs, bands or renders
_SPEEDY: Final = {**STILL, "hard_prune_iters": (0, 1), "hard_prune_share": 0.4, "soft_prune_iters": ()}
# sensitivities are of opacities before their reset, which comes after the same step
_SOFTLY: Final = {
    **STILL, "hard_prune_iters": (), "soft_prune_iters": (1,), "soft_prune_share": 0.4, "reset_every": 1,
    "refine_start_iter": 0, "refine_stop_iter": 4, "refine_every": 50,
}  # fmt: skip
_MINI: Final = {**STILL, "reinit_iters": (), "sample_iter": 90, "prune_iter": 1, "prune_mass": 0.25, "sh_start_iter": 0}
_PUP: Final = {**STILL, "rounds_start_iter": 1, "round_steps": 3, "prune_shares": (0.5,), "score_divisor": 2}


def _pruned(method: str, settings: Mapping[str, Any], seed: int) -> ShortTraining:
    short = ShortTraining(method, settings, SHORT, (0, 1), seed, count=9, views=3, held_out=1)
    # of one band, which is drawn from the second step on
    return replace(short, degree=1, options={**SHORT, "sh_interval": 1}) if seed == 24 else short


PRUNED: Final = [
    _pruned(method, settings, seed)
    for method, seeds, settings in (("speedy-splat", (8, 34), _SPEEDY), ("mini-splatting", (6,), _MINI),
                                    ("pup", (3, 24), _PUP))
    for seed in seeds
]  # fmt: skip
SOFTLY: Final = _pruned("speedy-splat", _SOFTLY, 18)
_PRUNED_INSIDE: Final = [
    replace(_pruned(method, settings, seed), held_out=0, masked=True, background=_BEHIND, antialiased=antialiased)
    for method, settings, seed, antialiased in (("speedy-splat", _SPEEDY, 100, True), ("pup", _PUP, 104, False))
]
_STARTS: Final = {"reinit_iters": (1,), "reinit_points": 60, "sample_iter": 90, "prune_iter": 91}
_ANEW_INSIDE: Final = ShortTraining(
    "mini-splatting", {**STILL, **_STARTS}, SHORT, (0, 1), seed=6, centred=True, masked=True
)
_LATER: Final = ("3dgs", "taming", "speedy-splat")
# principal points lie off the centre, where Inria's code takes them to be
OF_METHODS: Final = [ShortTraining(method, order=(0, 1), seed=14 if method in _LATER else 11) for method in RECIPE_OF]


class AtOneDepth(ShortTraining):
    """A short training of dozens that lie at nearly one depth, in another order than their rows, and one far behind.

    Sorts that deal depths into parts of their range have more in one part than they may expect.
    """

    @functools.cached_property
    def params(self) -> Mapping[str, np.ndarray]:
        rows = super().params
        depths = 4.0 + 2.0**-12 * (7 * np.arange(self.count) % self.count)
        depths[-1] = 4000.0
        faint = in_precision(0.25 * rows["opacities"] - 2.0)
        return _at_depths({**rows, "opacities": faint}, self.cameras[0], depths)


class SeenFirst(ShortTraining):
    """A short training in which the first Gaussian is seen, and dominates pixels; of others it is behind the camera."""

    @functools.cached_property
    def params(self) -> Mapping[str, np.ndarray]:
        return raw_params(gaussians(self.seed, self.degree, self.count, self.size, seen_first=True))


class OverManyTiles(ShortTraining):
    """A short training on a picture of one row, whose third Gaussian lies over more tiles than a word has bits."""

    @functools.cached_property
    def _every_camera(self) -> list[Camera]:
        # pixels are square
        return [replace(c, K=np.array([c.K[0], [0.0, c.K[0, 0], c.K[1, 2]], c.K[2]])) for c in super()._every_camera]

    @functools.cached_property
    def params(self) -> Mapping[str, np.ndarray]:
        rows = {name: array.copy() for name, array in super().params.items()}
        R, t = self.cameras[0].viewmat[:3, :3], self.cameras[0].viewmat[:3, 3]
        seen = rows["means"] @ R.T + t
        # at the height of the picture, as no other row of pixels is there
        seen[:, 1] = np.linspace(-0.4, 0.4, self.count) * seen[:, 2] / self.cameras[0].K[1, 1]
        seen[2, 0] = (0.5 * self.size[0] - self.cameras[0].K[0, 2]) * seen[2, 2] / self.cameras[0].K[0, 0]
        rows["means"] = in_precision((seen - t) @ R)
        # round and not turned, so that a turn changes nothing: rounding would cost more than gradients by it are
        rows["scales"][2], rows["quats"][2] = 0.5, (1.0, 0.0, 0.0, 0.0)
        return rows


class BehindTheOpaque(ShortTraining):
    """A short training in which three opaque Gaussians end every pixel before dozens that lie behind them."""

    @functools.cached_property
    def params(self) -> Mapping[str, np.ndarray]:
        rows, depths = dict(super().params), 3.0 + np.arange(self.count)
        rows = {name: array.copy() for name, array in _at_depths(rows, self.cameras[0], depths).items()}
        R, t = self.cameras[0].viewmat[:3, :3], self.cameras[0].viewmat[:3, 3]
        opaque = slice(3, 6)
        rows["opacities"][opaque], rows["scales"][opaque] = 6.5, np.log([[20.0], [25.0], [30.0]])
        rows["means"][opaque] = (np.array([[0.0, 0.0, depth] for depth in depths[opaque]]) - t) @ R
        return {name: in_precision(array) for name, array in rows.items()}


def _at_depths(rows: Mapping[str, np.ndarray], camera: Camera, depths: np.ndarray) -> dict[str, np.ndarray]:
    """Return Gaussians moved along their rays to other depths, as large on the screen; those behind stay."""
    R, t = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    seen = rows["means"] @ R.T + t
    grown = np.where(seen[:, 2:] > 0.0, depths[:, None] / seen[:, 2:], 1.0)
    return {
        **rows,
        "means": in_precision((seen * grown - t) @ R),
        "scales": in_precision(rows["scales"] + np.log(grown)),
    }


_ONE_LOOK: Final = {"settings": PRIOR.settings, "options": PRIOR.options, "order": (0,), "scene_scale": 4.0}
CORNERS: Final = [
    AtOneDepth(**_ONE_LOOK, seed=1, count=40, size=(5, 5)),
    OverManyTiles(**_ONE_LOOK, seed=14, count=7, size=(1041, 1)),
    BehindTheOpaque(**_ONE_LOOK, seed=3, count=40),
    *(
        SeenFirst(**{f.name: getattr(short, f.name) for f in fields(short)})
        # the mask leaves out all that the fourth dominates
        for short in (PRIOR, replace(MASKED, seed=62, order=(0,)))
    ),
]


def _cases() -> dict[str, ShortTraining]:
    """Return what is trained, by name."""
    found = {
        "prior": PRIOR, "prior_of_a_window": WINDOW, "entropy": ENTROPY, "masked": MASKED,
        "hidden": HIDDEN,
        "of_several_tiles": LARGE[0], "masked_of_several_tiles": LARGE[1],
        "aside": ASIDE,
        "unseen": UNSEEN,
        "of_other_rates": replace(PRIOR, options={**PRIOR.options, "lr": _OTHER_RATES}),
        "opacities_that_rest": replace(PRIOR, settings={**PRIOR.settings, "opacities_stop_iter": 0}, order=(0, 1)),
        # dominated pixels that a mask leaves out, and the share of all pixels, would be others
        "blurred_inside_masks": _BLURRED_INSIDE,
        "at_one_depth": CORNERS[0], "over_many_tiles": CORNERS[1], "behind_the_opaque": CORNERS[2],
        "with_the_first_seen": CORNERS[3], "masked_with_the_first_seen": CORNERS[4],
        "of_two_views": BATCHES[0],
        "of_two_views_that_grow": BATCHES[1],
        "of_two_views_that_blur_inside_masks": replace(_BLURRED_INSIDE, batch=2, order=(1, 0) * 3),
        "of_all_bands": BANDS[0], "of_one_band": BANDS[1],
        "waiting": WAITING, "outlasted": OUTLASTED, "rewound": REWOUND, "changed": CHANGED, "blurred": BLURRED,
        "of_few_photographs": FEW, "of_few_masked_photographs": replace(FEW, masked=True, scene_scale=0.5),
    }  # fmt: skip
    found |= {f"pruned_by_{s.method}_{s.seed}": replace(s, held_out=0) for s in PRUNED}
    found["pruned_before_a_reset"] = replace(SOFTLY, held_out=0)
    found |= {f"pruned_inside_masks_by_{s.method}": s for s in _PRUNED_INSIDE}
    found |= {"begun_anew": _ANEW_INSIDE} | {f"of_{s.method}": s for s in OF_METHODS}
    return {f"steps_{name.replace('-', '_')}": short for name, short in found.items()}


# what a recipe says besides its strategy, by the names of `Recipe`
_RECIPE: Final = ("pixelwise", "lambda_ssim", "pixel_scale", "d_ssim_halved", "padding", "l2_stop_iter", "max_steps",
                  "sh_interval", "depth_lambda", "opacity_reg", "scale_reg")  # fmt: skip
_REST: Final = {"means": "3", "scales": "3", "quats": "4", "opacities": "", "sh0": "1, 3", "shN": "n_rest, 3"}
_STATES: Final = {"params": "raw parameters", "m": "Adam's first moments", "v": "Adam's second moments"}
# a row that may move by a larger share of its rate is not compared
_SPREAD: Final = 0.25
# units of rounding that a point of a picture and a distance to neighbours may be off by
_ANEW: Final = 64.0


def steps_vectors() -> dict[str, Vector]:
    """Return what the oracle makes of every step."""
    return {name: _vector(short) for name, short in _cases().items()}


def _vector(short: ShortTraining) -> Vector:
    recorded, kept = copy.copy(short), KeptDraws(short.draws())
    # of this one alone, which is frozen
    object.__setattr__(recorded, "draws", lambda: kept)
    taken, wanted, before = OracleSteps(recorded, np.float32), list[WantedStep](), list[Rows]()
    for step in range(short.steps):
        rows = taken.rows
        # without the sizes that come with the rows of the last step
        given = Rows(*({key: in_precision(of[key]) for key in KEYS} for of in (rows.params, rows.m, rows.v)))
        taken.go_on(given)
        before.append(given)
        wanted.append(taken.step(*short.order[step * short.batch : (step + 1) * short.batch]))
    arrays = _shown(short) | {"draws": kept.flat, "step_rows": _lengths(before)}
    for kind in _STATES:
        arrays |= {f"{kind}_{key}": np.concatenate([getattr(rows, kind)[key] for rows in before]) for key in KEYS}
    recipe: Any = taken.recipe
    options = {
        "method": short.method, "settings": {**method_settings(short.method), **short.settings},
        "recipe": {name: getattr(recipe, name) for name in _RECIPE}, "lr": asdict(recipe.lr),
        "profile": asdict(recipe.profile), "scene_scale": short.scene_scale, "antialiased": short.antialiased,
        "batch": short.batch, "width": short.size[0], "height": short.size[1],
    }  # fmt: skip
    return arrays | _answers(wanted), options


def _shown(short: ShortTraining) -> dict[str, np.ndarray]:
    views, (width, height) = range(short.views), short.size
    masks = [short.mask(k) for k in views]
    sees = np.zeros((short.views, short.sparse), dtype=bool)
    for k in views if short.sparse else ():
        sees[k, short.seen(k)] = True
    return {
        "order": np.array(short.order),
        "viewmats": np.stack([camera.viewmat for camera in short.cameras]),
        "Ks": np.stack([camera.K for camera in short.cameras]),
        "photos": np.stack([short.photo(k) for k in views]).astype(np.int64),
        "masks": np.stack([np.ones((height, width), dtype=bool) if mask is None else mask for mask in masks]),
        "background": np.array(short.background),
        "points": short.cloud if short.sparse else np.zeros((0, 3)),
        "sees": sees,
    }


def _lengths(rows: list[Rows]) -> np.ndarray:
    return np.array([len(each) for each in rows])


def _answers(wanted: list[WantedStep]) -> dict[str, np.ndarray]:
    limit = tolerances.agreement("steps.params", np.float32)
    found: dict[str, np.ndarray] = {
        "losses": np.array([step.loss for step in wanted]),
        "error_bound_losses": np.array([step.loss_size for step in wanted]),
        "clear_steps": np.array([step.clear for step in wanted]),
        "rows": _lengths([step.rows for step in wanted]),
        "judged_rows": np.repeat([step.clear for step in wanted], [len(step.rows) for step in wanted]),
    }
    for kind in _STATES:
        for key in KEYS:
            name = f"new_{kind}_{key}"
            found[name] = np.concatenate([getattr(step.rows, kind)[key] for step in wanted])
            found[f"error_bound_{name}"] = np.concatenate([_size(step, kind, key) for step in wanted])
    # the sizes of children of a split are their parent's, whose centre may be nearer to 0
    found["error_bound_new_params_means"] += np.abs(found["new_params_means"])
    for key in KEYS:
        found[f"decided_{key}"] = np.concatenate([step.clear & _decided(step, key) for step in wanted])
    # whose row a row is shows also where rounding decides the rest
    places = [np.full(step.rows.params["means"].shape, PLACE / limit) for step in wanted]
    return found | {"places": found["new_params_means"], "error_bound_places": np.concatenate(places)}


def _size(step: WantedStep, kind: str, key: str) -> np.ndarray:
    """Return the size of a unit of every entry; Gaussians that begin anew on the photographs come without one."""
    found: Any = step.rows.params.get(f"size {kind} {key}")
    return _ANEW * (np.abs(getattr(step.rows, kind)[key]) + 1.0) if found is None else found


def _decided(step: WantedStep, key: str) -> np.ndarray:
    spread = step.rows.params.get(f"spread {key}", np.zeros_like(step.rows.params[key]))
    return spread <= _SPREAD * step.rates[key]


def answered_steps(found: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Return a vector's outputs from what `pop_ref.short_training.taken_steps` returns."""
    answers = {f"new_{kind}_{key}": np.concatenate([step[kind][key] for step in found])
               for kind in _STATES for key in KEYS}  # fmt: skip
    answers |= {"losses": np.array([step["loss"] for step in found]), "places": answers["new_params_means"]}
    return answers | {"rows": np.array([len(step["params"]["means"]) for step in found])}


class HeldTraining(ShortTraining):
    """The short training of a vector, and the Gaussians that its steps begin with.

    Args:
        arrays: of the vector.
        options: of the vector.
    """

    def __init__(self, arrays: dict[str, np.ndarray], options: dict[str, Any]) -> None:
        usual, method = RECIPE_OF[options["method"]], options["method"]
        settings = {k: tuple(v) if isinstance(v, list) else v for k, v in options["settings"].items()}
        changed = {name: value for name, value in options["recipe"].items() if value != getattr(usual, name)}
        lr, profile = LearningRates(**options["lr"]), Profile(**options["profile"])
        changed |= {"lr": lr} if lr != usual.lr else {}
        changed |= {"profile": profile} if profile != usual.profile else {}
        behind = arrays["background"]
        super().__init__(
            method,
            {name: value for name, value in settings.items() if value != method_settings(method)[name]},
            changed,
            tuple(int(k) for k in arrays["order"]),
            views=len(arrays["photos"]),
            scene_scale=options["scene_scale"],
            masked=not np.all(arrays["masks"]),
            background=(float(behind[0]), float(behind[1]), float(behind[2])),
            antialiased=options["antialiased"],
            batch=options["batch"],
            sparse=len(arrays["points"]),
            size=(options["width"], options["height"]),
            degree=round(np.sqrt(arrays["params_shN"].shape[1] + 1)) - 1,
        )
        object.__setattr__(self, "_arrays", arrays)

    _arrays: dict[str, np.ndarray]

    @functools.cached_property
    def before(self) -> list[dict[str, dict[str, np.ndarray]]]:
        """Return "params", "m" and "v" that every step begins with."""
        lengths = self._arrays["step_rows"]
        rows = [slice(end - n, end) for end, n in zip(np.cumsum(lengths), lengths, strict=True)]
        return [{kind: {key: self._arrays[f"{kind}_{key}"][of] for key in KEYS} for kind in _STATES} for of in rows]

    @functools.cached_property
    def params(self) -> Mapping[str, np.ndarray]:
        return self.before[0]["params"]

    @functools.cached_property
    def cameras(self) -> list[Camera]:
        return [Camera(v, K, *self.size) for v, K in zip(self._arrays["viewmats"], self._arrays["Ks"], strict=True)]

    @functools.cached_property
    def held_out_cameras(self) -> list[Camera]:
        return []

    @functools.cached_property
    def cloud(self) -> np.ndarray:
        return self._arrays["points"]

    def photo(self, index: int) -> np.ndarray:
        return self._arrays["photos"][index].astype(np.uint8)

    def mask(self, index: int) -> np.ndarray | None:
        return self._arrays["masks"][index] if self.masked else None

    def seen(self, index: int) -> np.ndarray:
        return np.flatnonzero(self._arrays["sees"][index])

    def draws(self) -> Any:
        return HeldDraws(self._arrays["draws"])


def steps_kind() -> dict[str, Any]:
    """Return what the index says of steps."""
    arrays = {name: entry("input", *about) for name, about in _SHOWN.items()}
    for name in ("order", "photos", "step_rows"):
        arrays[name]["dtype"] = "int64"
    for name in ("masks", "sees"):
        arrays[name]["dtype"] = "bool"
    for kind, what in _STATES.items():
        for key, rest in _REST.items():
            arrays[f"{kind}_{key}"] = entry("input", axes("R", rest), f"{what} before the step: {key}")
            rule = f"steps.{'params' if kind == 'params' else key if kind == 'm' else 'squares'}"
            where = f"decided_{key}" if kind == "params" else "judged_rows"
            arrays |= output(f"new_{kind}_{key}", axes("A", rest), f"{what} after the step: {key}", rule, where)
    for key, rest in _REST.items():
        said = f"rounding cannot move the update of {key} by a quarter of its rate"
        arrays[f"decided_{key}"] = entry("mask", axes("A", rest), said, "bool")
    arrays |= output("losses", "[S]", "the loss before the step, with all its terms", "steps.loss", "clear_steps")
    arrays["rows"] = entry("output", "[S]", "Gaussians after the step", "int64", [equal()])
    said = "new_params_means once more, compared coarsely at every step: whose row a row is"
    coarse = close("steps.params", "error_bound_places")
    # PLACE in either precision
    coarse["limit"] = dict.fromkeys(coarse["limit"], coarse["limit"]["float32"])
    arrays["places"] = entry("output", "[A, 3]", said, compare=[coarse])
    arrays["error_bound_places"] = entry("error_bound", "[A, 3]", "what no step moves a Gaussian by, over the limit")
    arrays["clear_steps"] = entry("mask", "[S]", "rounding decides nothing of what the step sees", "bool")
    arrays["judged_rows"] = entry("mask", "[A]", "the same of each row", "bool")
    about = (
        "steps of a training on photographs by 'method' under 'settings' (of its strategy: POP term, "
        "density control, rules of updates), 'recipe' (loss and schedule) and 'lr' (learning rates; means times "
        "'scene_scale' times means_decay^(step / max_steps); those of scales, quats, sh0 and sh_rest times "
        "others_decay^(step / max_steps)). Steps count from 0, and Adam's from 1. Take each from the parameters and "
        "moments that the vector holds for it; the statistics of a window and gradients that wait go on from step to "
        "step. Of a step of several views losses and gradients are averaged, and the window sees one after the other. "
        "Photographs are compared as 0 to 1. pop_ref/settings.py says what every setting does"
    )
    return {"about": about, "arrays": arrays}


_SHOWN: Final = {
    "order": ("[O]", "which views the steps see, 'batch' of them each"),
    "viewmats": ("[V, 4, 4]", "world -> camera, of each view"),
    "Ks": ("[V, 3, 3]", "intrinsics, px, of each view"),
    "photos": ("[V, H, W, 3]", "photographs, 0 to 255"),
    "masks": ("[V, H, W]", "pixels that count"),
    "background": ("[3]", "colour behind everything"),
    "points": ("[L, 3]", "sparse points, world, for recipe.depth_lambda"),
    "sees": ("[V, L]", "whether each photograph sees them"),
    "step_rows": ("[S]", "Gaussians before the step; R is their sum"),
    "draws": ("[U]", "random numbers in the order of their use: normals [2, n, 3] of n split parents, uniforms [n]"),
}
