"""Methods and presets: the defaults of a run, and how what the user says is laid over them.

A default is the method's recipe (`pop_ref.recipes`), with the schedule multiplied by a scaler:

    what                                            scaled
    max_steps                                       yes; the means' learning rate decays over it, so that scales too
    refine start and stop, blur, POP                yes
    refine_every, reset_every                       up only: a shorter schedule has fewer changes and fewer resets, as
                                                    far apart as ever (see `DensityControl.scaled`)
    prune_too_big_after                             up only, as the reset interval that it stands for
    sh_interval, eval_steps, save_steps             yes
    lambda_pop                                      no, unless `scale_lambda_pop` asks for it
    learning rates, other weights, thresholds       no: Adam's step does not depend on the length of a run; preset
                                                    "quick" has its own
    checkpoint_every, log_every                     no: they are about time, not about the schedule

What the user sets is taken literally: neither a preset nor the scaler changes it. Settings go to
plain JSON values and back (`to_plain`, `from_plain`), with errors that name the field.
"""

from __future__ import annotations

import math
import types
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache
from typing import (
    TYPE_CHECKING,
    Any,
    Final,
    Literal,
    NamedTuple,
    Self,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from pop_fast import density
from pop_fast.density import DensityControl
from pop_fast.errors import PopError
from pop_ref.recipes import BASELINES, RECIPES, Recipe
from pop_ref.registry import Registry
from pop_ref.settings import DensityConfig, LearningRates, PopTerm, UpdateRules

if TYPE_CHECKING:
    from pop_fast.stages.losses import Loss


class Method(NamedTuple):
    """A method that can be trained."""

    strategy: type[DensityControl]  # density control, with the method's defaults; a class of its own
    recipe: Recipe  # that the rest of its defaults are from
    title: str  # what tables and pages call it


METHODS: Final[Registry[Method]] = Registry(
    "method",
    "pop_splatting.methods",
    {
        "pop": Method(density.POPStrategy, RECIPES["POP"], "POP"),
        "gsplat": Method(density.GsplatStrategy, RECIPES["gsplat"], "gsplat (default strategy)"),
        "3dgs": Method(density.InriaStrategy, RECIPES["3DGS"], "3DGS (Inria)"),
        "3dgs-2023": Method(density.Inria2023Strategy, RECIPES["3DGS 2023"], "3DGS (Inria, 2023)"),
        "pup": Method(density.PupStrategy, BASELINES["PUP-3DGS"], "PUP-3DGS"),
        "mini-splatting": Method(density.MiniSplattingStrategy, BASELINES["Mini-Splatting"], "Mini-Splatting"),
        "taming": Method(density.TamingStrategy, BASELINES["Taming-3DGS"], "Taming-3DGS"),
        "speedy-splat": Method(density.SpeedySplatStrategy, BASELINES["Speedy-Splat"], "Speedy-Splat"),
    },
    needs=("strategy", "recipe", "title"),
    error=PopError,
)
LOSSES: Final[Registry[Loss]] = Registry(
    "loss",
    "pop_splatting.losses",
    {"l2": "pop_fast.stages.losses:L2", "l1": "pop_fast.stages.losses:L1"},
    needs=("name", "pixelwise", "whole"),
    error=PopError,
)
# what the control was called when there was one
ALIASES: Final = {"adc": "gsplat"}
QUICK_SCALER: Final = 0.05
# chooses size and length by what is there: `pop_fast.train.automatic`
AUTOMATIC: Final = "auto"
PRESETS: Final = {"paper": 1.0, "quick": QUICK_SCALER, AUTOMATIC: 1.0}
# what "quick" multiplies the rates by: with so few steps the published rates are too low, and rates as high as these
# must fall towards the end. The rate of opacities is high enough. Chosen on fox; benchmarks/NOTES.md has the results on
# four captures. A longer schedule of "auto" begins with rates that are lower in proportion to its length, never below
# the published ones, and they fall by less
QUICK_RATES: Final = {"means": 12.0, "scales": 6.0, "quats": 6.0, "sh0": 8.0, "sh_rest": 12.0}
QUICK_DECAY: Final = 0.1
# Adam's second moments: the usual 0.999 remembers most of so few steps, also those of coarse photographs. Longer
# schedules of "auto" come near it, and have it from a quarter on, where less memory gained nothing
QUICK_BETA2: Final = 0.99
QUICK_BETA2_UNTIL: Final = 0.25
# steps of the full schedule until which "quick" sees the photographs at a quarter, and at a half, of their size
QUICK_COARSE: Final = (5_000, 10_000)
# "quick" looks for what should grow twice as often, and asks for less of a gradient, as coarse photographs show less
QUICK_REFINE: Final = 0.5
QUICK_GRADIENT: Final = 0.75
# about what theta_blur comes to in the smallest images of the paper (10.7 in 980 x 545), so that 11 pixels are blur;
# "quick" is for images smaller than those
QUICK_BLUR_MIN_PIXELS: Final = 10.0
# of the full schedule: gsplat's trainer measures and saves then
MILESTONES: Final = (7_000, Recipe.max_steps)
# step numbers times this are still far from where a float ends
_LARGEST_SCALER: Final = 1e6


@dataclass(frozen=True, kw_only=True)
class Given:
    """What a run was asked for: what gives its defaults, and its explicit settings.

    Attributes:
        method: "pop", "gsplat" for gsplat's default strategy, "3dgs" for Inria's constants, learning rates, SSIM and
            rasterizer, "3dgs-2023" for those before October 2024; "pup", "mini-splatting", "taming" and "speedy-splat"
            build on these; or one that another package registers.
        preset: "paper" is the paper's 30,000 steps, for a GPU or a night; "quick" 1,500 steps at higher rates that
            fall, from coarse photographs to fine ones, with thresholds for small images; "auto" has these thresholds
            and as much of the schedule as the time allows, which `pop train` chooses (it is as "quick" is with no more
            steps than "quick", and up to 0.6 of the schedule some of its rates are higher than the paper's); explicit
            settings win over a preset's defaults.
        steps_scaler: multiplies the default of every step number; None takes the preset's.
        scale_lambda_pop: divide the default of lambda_pop by the scaler, so that the push of the prior adds up to the
            same over a short schedule; it then weighs more against the photographs than in the paper.
        settings: what the user set, as plain values by dotted name.
    """

    method: str = "pop"
    preset: Literal["paper", "quick", "auto"] = "paper"
    steps_scaler: float | None = None
    scale_lambda_pop: bool = False
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise PopError(f"config.method is {self.method!r}; it must be one of {', '.join(map(repr, METHODS))}")
        _check_method(self.method, METHODS[self.method])
        scaler = self.steps_scaler
        if scaler is not None and not 0.0 < scaler < math.inf:
            raise PopError(f"steps_scaler is {scaler}; it must be > 0 and finite")
        least = 1.0 / _LARGEST_SCALER
        if scaler is not None and not least <= scaler <= _LARGEST_SCALER:
            raise PopError(f"steps_scaler is {scaler}; it must lie in [{least:g}, {_LARGEST_SCALER:.0f}]")

    @classmethod
    def of(cls, overrides: Mapping[str, Any], **plan: Any) -> Self:
        """Check method, preset and scaler, and flatten what the user set.

        Args:
            overrides: settings by name; those of a group with a dot, or the group as a dict or whole.
            plan: method, preset, steps_scaler, scale_lambda_pop; None leaves the default.

        Raises:
            PopError: method, preset or scaler cannot be; names it.
        """
        plan = {name: value for name, value in plan.items() if value is not None}
        if "method" in plan:
            plan["method"] = ALIASES.get(plan["method"], plan["method"])
        given = from_plain(cls, plan, "config", skipped=("settings",))
        settings: dict[str, Any] = {}
        for name, value in overrides.items():
            group, dot, rest = name.partition(".")
            known = group == "strategy" or ALIASES.get(group, group) == given.method
            path = f"{given.method}{dot}{rest}" if known else name
            if isinstance(value, DensityControl) and method_of(type(value)) != given.method:
                raise PopError(
                    f"{name} is a {type(value).__name__}, but the method is {given.method!r}; "
                    f"give a {METHODS[given.method].strategy.__name__}, or method={method_of(type(value))!r}"
                )
            plain = to_plain(value)
            whole = isinstance(plain, dict) or is_dataclass(value)
            settings |= {f"{path}.{key}": item for key, item in plain.items()} if whole else {path: plain}
        return replace(given, settings=settings)

    @classmethod
    def from_plain(cls, plain: Any, where: str) -> Self:
        """Read what `to_plain` makes of this.

        Raises:
            PopError: a field is unknown or of the wrong type; names it.
        """
        settings = plain.get("settings") if isinstance(plain, dict) else None
        if not isinstance(settings, dict):
            raise PopError(f"{where}.settings is {settings}; it must be an object of settings")
        rest = {name: value for name, value in plain.items() if name != "settings"}
        return replace(from_plain(cls, rest, where, skipped=("settings",)), settings=settings)

    def to_plain(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        names = ("method", "preset", "steps_scaler", "scale_lambda_pop")
        return {**{name: getattr(self, name) for name in names}, "settings": dict(self.settings)}

    @property
    def scaler(self) -> float:
        """What the defaults of step numbers are multiplied by."""
        return PRESETS[self.preset] if self.steps_scaler is None else self.steps_scaler

    @property
    def few_steps(self) -> bool:
        """Whether rates, growth and photographs are those for few steps, as of "quick"."""
        return self.preset == "quick" or (self.preset == AUTOMATIC and self.scaler <= QUICK_SCALER)


def _check_method(name: str, method: Method) -> None:
    """Refuse what another package calls a method and is none."""
    kind: Any = method.strategy
    fault = None
    if not (isinstance(kind, type) and issubclass(kind, DensityControl)):
        fault = f"its strategy is {kind!r}; it must be a class derived from DensityControl"
    elif not isinstance(method.recipe, Recipe):
        fault = f"its recipe is {method.recipe!r}; it must be a pop_ref.recipes.Recipe"
    elif (owner := method_of(kind)) != name:
        fault = f"its {kind.__name__} is that of method {owner!r}, by which runs tell theirs; derive a class of its own"
    if fault is not None:
        raise PopError(f"method {name!r}{''.join(f' of {p}' for p in METHODS.packages(name))}: {fault}")


def method_of(strategy: type[DensityControl]) -> str:
    """Return the name of the method that a strategy's class belongs to; that of the class for a third-party one."""
    names = (name for name, method in METHODS.usable() if strategy is method.strategy)
    return next(names, strategy.__name__)


def defaults(given: Given) -> dict[str, Any]:
    """Return every setting that method, preset and scaler decide, without overrides, by its name in `TrainConfig`."""
    recipe, by = METHODS[given.method].recipe, given.scaler
    values = values_of(recipe)
    strategy = METHODS[given.method].strategy().scaled(by)
    if given.scale_lambda_pop:
        strategy = replace(strategy, lambda_pop=strategy.lambda_pop / by)
    if given.preset in ("quick", AUTOMATIC):
        strategy = replace(strategy, blur_min_pixels=QUICK_BLUR_MIN_PIXELS)

    def scaled(step: int) -> int:
        return max(round(step * by), 1)

    if given.few_steps:
        strategy = _quick(strategy)
        values["coarse_stop_iters"] = tuple(scaled(step) for step in QUICK_COARSE)
    if given.few_steps or given.preset == AUTOMATIC:
        values["lr"] = _quicker(recipe.lr, 1.0 if given.few_steps else QUICK_SCALER / by)

    for name in ("max_steps", "sh_interval", "l2_stop_iter"):
        values[name] = None if values[name] is None else scaled(values[name])
    milestones = tuple(scaled(step) for step in MILESTONES)
    return {**values, "eval_steps": milestones, "save_steps": milestones, "strategy": strategy}


def _quicker(lr: LearningRates, share: float) -> LearningRates:
    """Return rates that begin at this share of what "quick" has more than the published ones, and fall as far."""
    rates = {name: max(factor * share, 1.0) * getattr(lr, name) for name, factor in QUICK_RATES.items()}
    usual = QUICK_SCALER / QUICK_BETA2_UNTIL
    beta2 = lr.beta2 + (QUICK_BETA2 - lr.beta2) * max(share - usual, 0.0) / (1.0 - usual)
    return replace(lr, **rates, others_decay=min(QUICK_DECAY / share, lr.others_decay), beta2=beta2)


def _quick(strategy: DensityControl) -> DensityControl:
    """Return density control for few steps."""
    return replace(
        strategy,
        refine_every=max(round(strategy.refine_every * QUICK_REFINE), 1),
        grow_grad2d=strategy.grow_grad2d * QUICK_GRADIENT,
    )


def values_of(recipe: Recipe) -> dict[str, Any]:
    """Return what a recipe says apart from density control and the POP term, in the names of `TrainConfig`."""
    return {
        **{name: getattr(recipe, name) for name in ("max_steps", "sh_interval")},
        "photometric": recipe.pixelwise,
        "photometric_divisor": 1.0 / recipe.pixel_scale,
        **{name: getattr(recipe, name) for name in ("lambda_ssim", "l2_stop_iter")},
        "ssim_padding": recipe.padding,
        "d_ssim_halved": recipe.d_ssim_halved,
        "profile": recipe.profile.name,
        "lr": recipe.lr,
        **{name: getattr(recipe, name) for name in ("depth_lambda", "opacity_reg", "scale_reg")},
    }


def options_for(recipe: Recipe) -> list[str]:
    """Return the options of `pop train` that make it run a recipe: of the method that takes the fewest."""
    return min((_options(recipe, name) for name in METHODS), key=len)


def _options(recipe: Recipe, method: str) -> list[str]:
    base = METHODS[method].recipe
    pairs = [(name, values_of(recipe)[name], value) for name, value in values_of(base).items()]
    groups = ((DensityConfig, recipe.density, base.density), (PopTerm, recipe, base))
    for kind, ours, theirs in (*groups, (UpdateRules, recipe.updates, base.updates)):
        pairs += [(f"{method}.{f.name}", getattr(ours, f.name), getattr(theirs, f.name)) for f in fields(kind)]
    rates = [(f"lr.{f.name}", getattr(recipe.lr, f.name), getattr(base.lr, f.name)) for f in fields(recipe.lr)]
    chosen = [] if method == Given.method else ["--method", method]
    for name, ours, theirs in [*(pair for pair in pairs if pair[0] != "lr"), *rates]:
        if ours != theirs:
            chosen += _words(name, ours)
    return chosen


def words_of(given: Given, without: Collection[str] = ()) -> list[str]:
    """Return the options of `pop train` that ask for a run as it was asked for, without some settings."""
    words = [] if given.method == Given.method else ["--method", given.method]
    words += ["--preset", given.preset] if given.preset != Given.preset else []
    words += [] if given.steps_scaler is None else ["--steps-scaler", _number(given.steps_scaler)]
    words += ["--scale-lambda-pop"] if given.scale_lambda_pop else []
    for name, value in given.settings.items():
        if name not in without and value is not None:
            words += _words(name, value)
    return words


def _words(name: str, value: Any) -> list[str]:
    group, dot, rest = name.replace("_", "-").rpartition(".")
    if isinstance(value, bool):
        return [f"--{group}{dot}{'' if value else 'no-'}{rest}"]
    if isinstance(value, list | tuple):
        return [f"--{group}{dot}{rest}", *map(str, value)]
    return [f"--{group}{dot}{rest}", _number(value) if isinstance(value, float) else str(value)]


def _number(value: float) -> str:
    """Write a number in few digits where these read back as the same number."""
    return f"{value:g}" if float(f"{value:g}") == value else str(value)


def laid_over(plain: dict[str, Any], given: Given) -> dict[str, Any]:
    """Lay what was said over the plain values of a run, whose groups are dicts; names that are not there are added."""
    merged = {name: dict(value) if isinstance(value, dict) else value for name, value in plain.items()}
    for path, value in given.settings.items():
        group, dot, name = path.partition(".")
        target = "strategy" if group == given.method else group
        if dot and isinstance(merged.get(target), dict):
            merged[target][name] = value
        else:
            merged[path] = value
    return merged


T = TypeVar("T")
# up to here a float holds every whole number
_LARGEST = 2**53
# compiling the annotations takes as long as all else
_hints: Callable[[type], dict[str, Any]] = cache(get_type_hints)


def to_plain(value: Any) -> Any:
    """Turn nested dataclasses, dicts and tuples into dicts and lists."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {name: to_plain(item) for name, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [to_plain(item) for item in value]
    return value


def from_plain(kind: type[T], plain: Any, where: str, skipped: tuple[str, ...] = ()) -> T:
    """Build a dataclass from what `to_plain` made of it; absent fields keep their default.

    Args:
        skipped: fields that plain values cannot give.

    Raises:
        PopError: an unknown field, or a value of the wrong type; names it as `where.field`.
    """
    if not isinstance(plain, dict):
        raise PopError(f"{where} is {_shown(plain)}; it must be an object of settings")
    hints = {name: hint for name, hint in _hints(kind).items() if name not in skipped}
    for name in plain:
        if name not in hints:
            raise PopError(f"{where}.{name} is not a setting; the settings are {', '.join(hints)}")
    return kind(**{name: _value(hints[name], value, f"{where}.{name}") for name, value in plain.items()})


def _value(hint: Any, value: Any, where: str) -> Any:
    origin, args = get_origin(hint), get_args(hint)
    if is_dataclass(hint) and isinstance(hint, type):
        return from_plain(hint, value, where)
    if origin is Literal:
        if value not in args:
            raise PopError(f"{where} is {_shown(value)}; it must be one of {', '.join(map(_shown, args))}")
        return value
    if origin in (Union, types.UnionType):
        if value is None and type(None) in args:
            return None
        return _value(next(arg for arg in args if arg is not type(None)), value, where)
    if origin is tuple:
        if not isinstance(value, list):
            raise PopError(f"{where} is {_shown(value)}; it must be a list")
        any_length = len(args) == 2 and args[1] is Ellipsis
        if not any_length and len(value) != len(args):
            raise PopError(f"{where} has {len(value)} values; it must have {len(args)}")
        kinds = [args[0]] * len(value) if any_length else args
        return tuple(_value(k, item, f"{where}[{i}]") for i, (k, item) in enumerate(zip(kinds, value, strict=True)))
    return _scalar(hint, value, where)


def _scalar(hint: Any, value: Any, where: str) -> Any:
    if isinstance(value, int) and abs(value) > _LARGEST:
        raise PopError(f"{where} is a number beyond 2^53; no setting is as large")
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, hint) or (hint is not bool and isinstance(value, bool)):
        names = {int: "a whole number", float: "a number", str: "a text", bool: "true or false"}
        raise PopError(f"{where} is {_shown(value)}; it must be {names[hint]}")
    return value


def _shown(value: Any) -> str:
    return f"'{value}'" if isinstance(value, str) else str(value)
