"""Everything a training run is decided by, as one frozen value that goes through JSON and back unchanged.

A `TrainConfig` holds the values as they are run. `TrainConfig.of` makes one as the command line does: method, preset
and `steps_scaler` give the defaults (see `pop_fast.train.presets`), and what the user sets wins, taken literally.
A value that a setting cannot have is refused in one line that names the setting as `pop train` does.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final, Literal, Self

from pop_fast.api.backend import BACKENDS
from pop_fast.density import DensityControl, POPStrategy
from pop_fast.errors import PopError
from pop_fast.io.ply import DRAWN_BY
from pop_fast.train.presets import (
    LOSSES,
    METHODS,
    MILESTONES,
    Given,
    defaults,
    from_plain,
    laid_over,
    method_of,
    to_plain,
)
from pop_ref.constants import NEAR_IN_CAPTURE_UNITS, PAPER, PROFILES, Profile, profile_named
from pop_ref.settings import BETAS, MAX_SH_DEGREE, AppearanceRates, LearningRates, Objective, Recipe

__all__ = ["LearningRates", "TrainConfig", "first_difference"]

# what may differ between a checkpoint and the run that resumes it: it does not reach a single bit of the parameters.
# log_every is not among it: where Gaussians per pixel are counted, tile lists are cut and sums rounded otherwise
_FREE: Final = frozenset(
    {
        *("data", "result_dir", "eval_steps", "save_steps", "checkpoint_every", "keep_checkpoints"),
        *("max_renders", "progress", "lpips_vgg", "lpips_alex", "target_cache_mb"),
    }
)
# a batch of one, a profile's own near plane and low-pass, photographs at their size, rates that stay, Adam's usual
# decay and no regularizers are what every run had before there were others: its checkpoints say nothing of them
_USUAL: Final = {
    "batch_size": 1,
    "near_plane": None,
    "eps2d": None,
    "coarse_stop_iters": [],
    "lr.others_decay": 1.0,
    "lr.beta2": BETAS[1],
    "depth_lambda": 0.0,
    "opacity_reg": 0.0,
    "scale_reg": 0.0,
}
# settings of density control that are gone, with the value at which they did nothing: results with it still open
_GONE: Final = {"blur_stop_gain": 0.0, "blur_stop_span": 5}
# the two parts of cfg.json, and the packages of others that the run uses, where there are some
_GIVEN, _RESOLVED, _PACKAGES = "given", "resolved", "packages"
# settings that are names of a table, to which other packages may add
_TABLES: Final = {"method": METHODS, "profile": PROFILES, "photometric": LOSSES, "backend": BACKENDS}
_OF_OTHERS: Final = "; one from another package is known only where that is installed"


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Settings of a training run as the run uses them; the defaults are the paper's.

    Attributes:
        data: the capture: a COLMAP folder, a folder with transforms.json, or a folder of photographs.
        result_dir: the folder that the run writes to.
        max_steps: training steps, of `batch_size` views each.
        batch_size: views of a step; its loss is the mean of the losses that steps of each view alone would have. Rates
            and step numbers do not change with it.
        seed: of the view order, the initial rotations and the split noise.
        backend: renders and trains: "fast" (CPU), "compiled" (CPU, with kernels in C++), "cuda", "ref" (the oracle,
            slow), one that another package registers, or "auto", which takes the first of "cuda", "compiled" and "fast"
            that can run here.
        profile: the rasterizer's constants: "paper", "gsplat_1_5", "gsplat_1_6", "inria" (that of method "3dgs" and of
            those built on it), "speedy_splat", or one that another package registers.
        near_plane: depth up to which a camera shows nothing, in units of the training frame; None takes the profile's.
            Profiles of Inria's family state it in the capture's own units, and the run records the converted value.
        eps2d: low-pass, px^2; None takes the profile's.
        antialiased: render with opacity compensation (Mip-Splatting) instead of classically.
        factor: whole number by which photographs are shrunk.
        resize: how they are shrunk if the capture has no photographs of that size: "area" averages, "bicubic" equals
            Pillow's. gsplat's example trainer uses the latter, on the full photographs (--images images) instead of the
            shrunk ones of Mip-NeRF 360 (A32).
        coarse_stop_iters: coarse to fine: before each of these steps photographs are shrunk by a further factor of 2.
            (300, 600) shrinks by 4 until step 300 and by 2 until step 600. Empty in preset "paper".
        test_every: every n-th view by file name is held out, 0 holds none out; if a capture lists its held-out views,
            these are.
        background: colour behind everything, and behind photographs with alpha. [0, 1]
        normalize: move the capture into gsplat's normalised world.
        sh_degree: highest band of the colours.
        sh_interval: steps between bands, from band 0 at step 0.
        init_opacity: opacity of the first Gaussians.
        init_scale: multiplies their size, which is the distance to their three nearest neighbours.
        photometric: loss between pixels: "l2" (paper eq. 9, POP), "l1" (eq. 2, the other methods), or one that another
            package registers.
        photometric_divisor: divides that term, as in the paper's figure of L1/n against L2.
        lambda_ssim: weight of 1 - SSIM; the loss between pixels has the rest. It is 0.01 for POP and 0.2 for the other
            methods.
        l2_stop_iter: step from which eq. 2 (L1, 0.2) replaces the loss; None is never. The paper says only of the POP
            term that it ends (A20).
        ssim_padding: "valid" as gsplat, or "same" as Inria (and method "3dgs").
        d_ssim_halved: (1 - SSIM) / 2 instead of 1 - SSIM.
        lr: learning rates.
        depth_lambda: weight of the depth term, for captures of few photographs: mean difference of disparities at the
            sparse points that a photograph sees (COLMAP's tracks), times the scene's scale. gsplat's trainer has 0.01;
            0 is off.
        opacity_reg: weight of the mean opacity, as in gsplat's trainer; 0 is off.
        scale_reg: weight of the mean scale, per world unit, as in gsplat's trainer; 0 is off.
        exposure: learn an affine map of colours for every photograph, for captures whose exposure or white balance
            changes. Held-out views are then also measured after fitting their colours (cc_psnr), as in gsplat's
            trainer.
        random_background: draw another background colour at every step, from seed and step, so that uncovered pixels
            cost something. A photograph with alpha is laid over the same colour.
        refine_cameras: learn a small rotation and translation of every training camera.
        appearance_lr: learning rates of exposures and cameras.
        strategy: density control and the POP term; its type is the method.
        threads: threads of one operation; 0 takes all cores. Equal numbers give equal bits; the native step (backend
            "compiled") gives the same bits for every number.
        eval_steps: numbers of steps after which the held-out views are measured; the last step is always one.
        save_steps: numbers of steps after which a PLY and a checkpoint are kept; the last step is always one.
        checkpoint_every: steps between the checkpoints that a run resumes from; 0 writes none of them.
        keep_checkpoints: how many of them are kept.
        log_every: steps between records of metrics.jsonl; such a step also counts the blended and traversed Gaussians,
            which doubles its cost.
        max_renders: held-out views saved as pictures at the end.
        lpips_vgg: weights of LPIPS on VGG16: one merged file, or backbone and linear layers; empty for none.
        lpips_alex: weights of LPIPS on AlexNet, in the same form.
        target_cache_mb: memory for SSIM's moments of the photographs, which are kept between steps.
        progress: show a progress bar if standard error is a terminal.
        given: preset and explicit settings behind these values; None if each value was set by itself.
    """

    data: str = ""
    result_dir: str = "results"
    max_steps: int = Recipe.max_steps
    batch_size: int = 1
    seed: int = 42
    backend: str = "auto"
    profile: str = PAPER.name
    near_plane: float | None = None
    eps2d: float | None = None
    antialiased: bool = False
    factor: int = 1
    resize: Literal["area", "bicubic"] = "area"
    coarse_stop_iters: tuple[int, ...] = ()
    test_every: int = 8
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    normalize: bool = True
    sh_degree: int = MAX_SH_DEGREE
    sh_interval: int = Recipe.sh_interval
    init_opacity: float = 0.1
    init_scale: float = 1.0
    photometric: str = Recipe.pixelwise
    photometric_divisor: float = 1.0 / Recipe.pixel_scale
    lambda_ssim: float = Recipe.lambda_ssim
    l2_stop_iter: int | None = Recipe.l2_stop_iter
    ssim_padding: Literal["valid", "same"] = Recipe.padding
    d_ssim_halved: bool = Recipe.d_ssim_halved
    lr: LearningRates = Recipe.lr
    depth_lambda: float = Recipe.depth_lambda
    opacity_reg: float = Recipe.opacity_reg
    scale_reg: float = Recipe.scale_reg
    exposure: bool = False
    random_background: bool = False
    refine_cameras: bool = False
    appearance_lr: AppearanceRates = field(default_factory=AppearanceRates)
    strategy: DensityControl = field(default_factory=POPStrategy)
    threads: int = 0
    eval_steps: tuple[int, ...] = MILESTONES
    save_steps: tuple[int, ...] = MILESTONES
    checkpoint_every: int = 1_000
    keep_checkpoints: int = 2
    log_every: int = 25
    max_renders: int = 12
    lpips_vgg: tuple[str, ...] = ()
    lpips_alex: tuple[str, ...] = ()
    target_cache_mb: int = 1024
    progress: bool = True
    given: Given | None = None

    def __post_init__(self) -> None:
        check_values(self)
        if self.given is None:
            return
        promised = self._promised(self.given)
        name = self._departs_from(promised, self.given)
        if name is not None:
            raise PopError(
                f"{name} is {getattr(self, name)}, but preset {self.given.preset!r} and its explicit settings make it "
                f"{getattr(promised, name)}; say it with config.with_overrides({name}=...), or replace given=None too"
            )

    @classmethod
    def of(cls, *, method: str = "pop", preset: str = "paper", **overrides: Any) -> Self:
        """Make the settings of a method and a preset, except for explicit ones.

        Args:
            method: as `Given.method`; "adc" is another name of "gsplat".
            preset: "paper", "quick" or "auto".
            overrides: `steps_scaler` and `scale_lambda_pop` (see `Given`), and settings by name, taken as they
                are: those of the strategy and the learning rates with a dot, `**{"pop.lambda_pop": 0.002}`, as a dict,
                `lr={"opacities": 0.01}`, or whole.

        Raises:
            PopError: an unknown setting, or a value that it cannot have; names it.
        """
        plan = {name: overrides.pop(name, None) for name in ("steps_scaler", "scale_lambda_pop")}
        given = Given.of(overrides, method=method, preset=preset, **plan)
        return replace(cls._promised(given), given=given)

    @classmethod
    def from_options(cls, words: Sequence[str], *, method: str = "pop", preset: str = "paper") -> Self:
        """Make the settings that options of `pop train` say, as `pop_fast.train.presets.options_for` writes them.

        Args:
            words: `--name value`, `--group.name value ...`, `--flag` and `--no-flag`.

        Raises:
            PopError: an unknown option, or a value that it cannot have; names it.
        """
        options, plan = dict(_options_of(words)), {"method": method, "preset": preset}
        for name in ("method", "preset", "steps_scaler", "scale_lambda_pop"):
            if name in options:
                plan[name] = (options.pop(name) or [True])[0]
        usual, said = cls.of(**plan).flat(), dict[str, Any]()
        dashed = {name.replace("-", "_"): name for name in usual}
        for option, values in options.items():
            group, dot, last = option.rpartition(".")
            name, positive = (dashed.get(n, n) for n in (option, f"{group}{dot}{last.removeprefix('no_')}"))
            if not values and name not in usual:
                said[positive] = False
            elif isinstance(usual.get(name), list):
                said[name] = values
            else:
                said[name] = values[0] if len(values) == 1 else " ".join(map(str, values)) or True
        # as the settings have them, in their order: a whole number where a real one is meant is one
        resolved = cls.of(**plan, **said).flat()
        return cls.of(**plan, **{name: resolved[name] for name in resolved if name in said})

    def with_overrides(self, **overrides: Any) -> Self:
        """Return these settings with some said anew; those not given stay the defaults they are."""
        if self.given is None:
            return replace(self, **overrides)
        again = Given.of(overrides, method=self.given.method)
        given = replace(self.given, settings={**self.given.settings, **again.settings})
        free = {name: value for name, value in _as_dict(self).items() if name not in defaults(given)}
        plain = to_plain({**_as_dict(self._promised(given)), **free})
        return replace(self._from_values(laid_over(plain, again), given.method), given=given)

    @classmethod
    def _promised(cls, given: Given) -> Self:
        """Build what a `Given` amounts to, without the label."""
        plain = {name: to_plain(value) for name, value in {**_as_dict(cls()), **defaults(given)}.items()}
        return cls._from_values(laid_over(plain, given), given.method)

    def _departs_from(self, promised: TrainConfig, given: Given) -> str | None:
        return next((name for name in defaults(given) if getattr(self, name) != getattr(promised, name)), None)

    @classmethod
    def _from_values(cls, values: dict[str, Any], method: str) -> Self:
        rest = {name: value for name, value in values.items() if name != "strategy"}
        own = values.get("strategy", {})
        if isinstance(own, dict):
            own = {name: value for name, value in own.items() if name not in _GONE or value != _GONE[name]}
        strategy = from_plain(METHODS[method].strategy, own, f"config.{method}")
        return replace(from_plain(cls, rest, "config", skipped=("given", "strategy")), strategy=strategy)

    @property
    def method(self) -> str:
        """The name of the method that is trained."""
        return method_of(type(self.strategy))

    @property
    def preset(self) -> str | None:
        """The preset that gave the defaults; None where every value was written down."""
        return None if self.given is None else self.given.preset

    @property
    def renderer(self) -> Profile:
        """The rasterizer's constants, with the near plane and the low-pass of these settings."""
        own = {name: getattr(self, name) for name in ("near_plane", "eps2d")}
        return replace(profile_named(self.profile), **{name: value for name, value in own.items() if value is not None})

    @property
    def drawn(self) -> tuple[tuple[str, str | float], ...]:
        """What a file has to say of how its splat is drawn: those of these settings that are not the usual ones."""
        usual = TrainConfig()
        own = ((name, getattr(self, name)) for name in DRAWN_BY)
        return tuple((name, value) for name, value in own if value != getattr(usual, name))

    def in_world(self, world_scale: float) -> Self:
        """Return these settings with the near plane of a world, unless one was set.

        Args:
            world_scale: length of one unit of the capture's own frame in the world that is trained in.
        """
        if self.near_plane is not None or self.profile not in NEAR_IN_CAPTURE_UNITS:
            return self
        return replace(self, near_plane=self.renderer.near_plane * world_scale)

    def objective_at(self, step: int) -> Objective:
        """Return what the render of a step is compared with its photograph by."""
        return Objective(
            pixelwise=self.photometric,
            pixel_scale=1.0 / self.photometric_divisor,
            lambda_ssim=self.lambda_ssim,
            padding=self.ssim_padding,
            d_ssim_halved=self.d_ssim_halved,
        ).at(step, self.l2_stop_iter)

    def to_json(self) -> str:
        """Write the settings as JSON, in reading order: as given (null where no preset was), and as they are run."""
        given = None if self.given is None else self.given.to_plain()
        resolved = {"method": self.method, **{n: to_plain(v) for n, v in _as_dict(self).items()}}
        of_others = [r.packages(resolved[name]) for name, r in _TABLES.items() if resolved[name] != "auto"]
        added = {_PACKAGES: sorted({package for found in of_others for package in found})} if any(of_others) else {}
        return json.dumps({_GIVEN: given, _RESOLVED: resolved, **added}, indent=2) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Read what `to_json` wrote; settings that are absent keep their default.

        The values as they are run are what counts. Where presets had other values when that was written, there is no
        label (`given` is None).

        Raises:
            PopError: not JSON, of an older layout, an unknown field, or a value of the wrong type; names the field.
        """
        try:
            plain = json.loads(text)
        except json.JSONDecodeError as error:
            raise PopError(f"config is not JSON: {error.msg} at line {error.lineno}, column {error.colno}") from error
        except (ValueError, RecursionError) as error:
            raise PopError(f"config is not JSON that can be read: {error}") from error
        packages = plain.pop(_PACKAGES, []) if isinstance(plain, dict) else []
        if not isinstance(plain, dict) or plain.keys() != {_GIVEN, _RESOLVED} or type(plain[_RESOLVED]) is not dict:
            raise PopError(f"config is not {{{_GIVEN}, {_RESOLVED}}}, so it is of an older version of pop or damaged")
        values = dict(plain[_RESOLVED])
        for name, registry in _TABLES.items():
            if isinstance(packages, list) and packages and values.get(name, "auto") not in ("auto", *registry):
                made_with = f"made with {' and '.join(map(str, packages))}, not all of which is installed here"
                raise PopError(f"config.{name} is {values[name]!r}, of another package; the run was {made_with}")
        method = values.pop("method", "pop")
        if method not in METHODS:
            names = ", ".join(map(repr, METHODS))
            raise PopError(f"config.method is {method!r}; it must be one of {names}{_OF_OTHERS}")
        config = cls._from_values(values, method)
        if plain[_GIVEN] is None:
            return config
        given = Given.from_plain(plain[_GIVEN], "config.given")
        follows = config._departs_from(cls._promised(given), given) is None
        return replace(config, given=given) if follows else config

    def binding(self) -> dict[str, Any]:
        """Return the settings that a resumed run must share, flat."""
        found = {name: value for name, value in self.flat().items() if name not in _FREE}
        return {name: value for name, value in found.items() if name not in _USUAL or value != _USUAL[name]}

    def flat(self) -> dict[str, Any]:
        """Return all settings as they are run, as plain values by dotted name."""
        flat: dict[str, Any] = {"method": self.method}
        for name, value in _as_dict(self).items():
            plain = to_plain(value)
            group = self.method if name == "strategy" else name
            flat |= {f"{group}.{key}": v for key, v in plain.items()} if isinstance(plain, dict) else {name: plain}
        return flat

    def digest(self) -> str:
        """Hash the settings that decide the result's bits."""
        return hashlib.sha256(json.dumps(self.binding(), sort_keys=True).encode()).hexdigest()


def _options_of(words: Sequence[str]) -> Iterator[tuple[str, list[Any]]]:
    """Give every option's name, as settings are called, with its values."""
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if not word.startswith("--"):
            raise PopError(f"{word!r} is not an option; pop train expects one here, such as --max-steps 100")
        name, equals, value = word.removeprefix("--").partition("=")
        values = [value] if equals else []
        while rest and not rest[0].startswith("--"):
            values.append(rest.pop(0))
        yield name.replace("-", "_"), [_read(value) for value in values]


def _read(text: str) -> Any:
    """Read a word as a number, as None, or as the text that it is."""
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return None if text == "None" else text


def _as_dict(config: TrainConfig) -> dict[str, Any]:
    return {f.name: getattr(config, f.name) for f in fields(config) if f.name != "given"}


def first_difference(ours: dict[str, Any], theirs: dict[str, Any]) -> tuple[str, Any, Any] | None:
    """Return the first setting in which two `binding()`s differ, with both values, or None."""
    for name in [*ours, *(name for name in theirs if name not in ours)]:
        mine, other = (values.get(name, _USUAL.get(name)) for values in (ours, theirs))
        if mine != other:
            return name, mine, other
    return None


def is_of_another_version(name: str, ours: dict[str, Any], theirs: dict[str, Any]) -> bool:
    """Tell whether another version of the package wrote the other of two `binding()`s, by a setting that differs.

    Only one of them can have it, or the other took the near plane of a profile in units of the training frame.
    """
    if name == "near_plane" and theirs.get(name) is None and theirs.get("profile") in NEAR_IN_CAPTURE_UNITS:
        return True
    return name not in _USUAL and (name not in ours or name not in theirs)


_AT_LEAST: Final = {
    **dict.fromkeys(("max_steps", "batch_size", "factor", "sh_interval", "keep_checkpoints", "log_every"), 1),
    **dict.fromkeys(("seed", "sh_degree", "test_every", "threads", "checkpoint_every", "max_renders"), 0),
    **dict.fromkeys(("target_cache_mb", "l2_stop_iter"), 0),
}
# photographs shrunk by 16 show little
_MOST_COARSE_STOPS: Final = 4
# views that a run draws; they and the rates of all steps are listed before the first step, so many in 12 s and 2 GB
_MOST_DRAWN: Final = 10_000_000
# each takes memory of its own, and beyond what the system allows the libraries end the process
_MOST_THREADS: Final = 512
# numbers that are divided by, or of which a logarithm is taken
_OVER_ZERO: Final = (
    *("init_scale", "photometric_divisor", "lr.means_decay", "lr.others_decay"),
    *("appearance_lr.exposures_decay", "appearance_lr.cameras_decay"),
)
# of the strategy, whose settings errors call by the method's name as the command line does
_AT_LEAST_OF_STRATEGY: Final = {
    **dict.fromkeys(("refine_every", "sh_rest_every", "round_steps", "round_decay_every"), 1),
    **dict.fromkeys(("score_views", "score_divisor", "reinit_points", "max_gaussians"), 1),
    **dict.fromkeys(("reset_every", "pause_refine_after_reset", "final_count", "sampled_prunes"), 0),
}
_SHARES_OF_STRATEGY: Final = (
    *("prune_opa", "theta_blur", "final_prune_opa", "soft_prune_share", "hard_prune_share"),
    *("prune_shares", "sampling_factor", "prune_mass"),
)
# of which a logarithm is taken from both sides
_BETWEEN_OF_STRATEGY: Final = ("reset_opa", "reinit_opacity")


def check_values(config: TrainConfig) -> None:
    """Check every setting of a run.

    Raises:
        PopError: a setting is out of range or, being a number, not finite.
    """
    values, method = config.flat(), config.method
    _check_names(values)
    own = {name: value for name, value in values.items() if name.startswith(f"{method}.")}
    shares = ("lambda_ssim", *(name for name in own if name.removeprefix(f"{method}.") in _SHARES_OF_STRATEGY))
    known = {f"{method}.{name}": least for name, least in _AT_LEAST_OF_STRATEGY.items()}
    at_least = {**_AT_LEAST, **{name: least for name, least in known.items() if name in own}}
    for name, smallest in at_least.items():
        if values[name] is not None and values[name] < smallest:
            raise PopError(f"{name} is {values[name]}; it must be at least {smallest}")
    drawn = values["max_steps"] * values["batch_size"]
    if drawn > _MOST_DRAWN:
        raise PopError(f"max_steps times batch_size is {drawn}; it must be at most {_MOST_DRAWN:,}")
    if values["threads"] > _MOST_THREADS:
        raise PopError(f"threads is {values['threads']}; it must be at most {_MOST_THREADS}; 0 takes all cores")
    if values["sh_degree"] > 3:
        raise PopError(f"sh_degree is {values['sh_degree']}; it must be 0, 1, 2 or 3")
    for name in ("init_opacity", "lr.beta2", *(f"{method}.{name}" for name in _BETWEEN_OF_STRATEGY)):
        if name in values and not 0.0 < values[name] < 1.0:
            raise PopError(f"{name} is {values[name]}; it must lie between 0 and 1")
    stops = values["coarse_stop_iters"]
    if any(stop < 0 for stop in stops) or stops != sorted(stops) or len(stops) > _MOST_COARSE_STOPS:
        raise PopError(
            f"coarse_stop_iters is {stops}; it must be at most {_MOST_COARSE_STOPS} step numbers that ascend"
        )
    if any(not 0.0 <= value <= 1.0 for value in values["background"]):
        raise PopError(f"background is {values['background']}; every channel must lie in [0, 1]")
    for name in (*_OVER_ZERO, *shares, *(name for name, value in values.items() if isinstance(value, float))):
        for value in values[name] if isinstance(values[name], list) else (values[name],):
            _check_number(name, value, name in shares)


def _check_names(values: dict[str, Any]) -> None:
    """Check what is one of a table, to which other packages may add."""
    for name, known in _TABLES.items():
        value = values[name]
        if name == "method" or (name == "backend" and value == "auto") or value in known:
            continue
        names = ", ".join((*(("auto",) if name == "backend" else ()), *known))
        raise PopError(f"{name} is {value!r}; it must be one of {names}{_OF_OTHERS}")


def _check_number(name: str, value: float, is_share: bool) -> None:
    if is_share:
        right, meaning = 0.0 <= value <= 1.0, "lie in [0, 1]"
    elif name in _OVER_ZERO:
        right, meaning = 0.0 < value < math.inf, "be > 0 and finite"
    else:
        right, meaning = 0.0 <= value < math.inf, "be >= 0 and finite"
    if not right:
        raise PopError(f"{name} is {value}; it must {meaning}")
