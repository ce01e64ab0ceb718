"""What a run refuses before it takes a step, and what it says of its settings on the photographs of a capture."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from torch import Tensor

from pop_fast.api.backends import FAST
from pop_fast.api.checks import Checks
from pop_fast.density import PupStrategy
from pop_fast.errors import PopError
from pop_fast.train.config import TrainConfig
from pop_fast.train.evaluate import too_small
from pop_fast.train.model import first_unusable
from pop_fast.train.views import ViewTensors
from pop_ref.constants import profile_named
from pop_ref.settings import GSPLAT

# theta_blur is about so many pixels in the smallest images of the paper (10.7 in 980 x 545, its section 4.1)
ENOUGH_PIXELS: Final = 10
# from a pixel on, a shifted image costs what a held-out PSNR shows
ENOUGH_OFF_CENTRE: Final = 1.0
# densification steps between two resets in 3DGS and in gsplat's default strategy: 3,000 steps, one each 100
RECOVERY_EVENTS: Final = GSPLAT.reset_every // GSPLAT.refine_every


def check_method(config: TrainConfig) -> None:
    """Raise PopError where a method asks the views, later, for what it cannot be told as they are drawn."""
    plan = config.strategy
    if config.antialiased and isinstance(plan, PupStrategy) and any(s < config.max_steps for s in plan.adam_restarts):
        raise PopError(
            f"antialiased is True, but method {config.method!r} prunes after step {plan.rounds_start_iter:,} by scores "
            "that leave out how antialiased opacities depend on scales; leave out --antialiased"
        )


def check_views(config: TrainConfig, name: str, train: Sequence[ViewTensors], test: Sequence[ViewTensors]) -> None:
    """Check the cameras of all views, and that each photograph can be compared as the settings ask.

    Args:
        test: held-out views, which are always measured by whole windows.

    Raises:
        PopError: names the capture, the view and what to do.
    """
    for view in (*train, *test):
        try:
            checks = Checks(FAST, view.viewmat.dtype)
            checks.cameras(view.viewmat, view.K, view.width, view.height, 1, ())
            checks.values()
        except ValueError as error:
            raise PopError(f"{name}: camera of {view.name}: {error}; correct it, or leave the view out") from error
    in_loss = too_small(train) if config.ssim_padding == "valid" else None
    measured = too_small(test)
    if in_loss or measured:
        instead = " ".join([*(["--ssim-padding same"] if in_loss else []), *(["--test-every 0"] if measured else [])])
        raise PopError(f"{name}: {in_loss or measured}; use larger images (a lower --factor), or {instead}")


def check_start(name: str, initial: Mapping[str, Tensor]) -> None:
    """Raise PopError, which names a number and says what to do, where the first Gaussians cannot be rendered."""
    found = first_unusable(initial)
    if found:
        key, index, value = found
        raise PopError(
            f"{name}: {key}{index} of the first Gaussians is {value}; lower --init-scale, "
            "or remove sparse points that are far from all others"
        )


def facts(config: TrainConfig, views: Sequence[ViewTensors]) -> dict[str, Any]:
    """Return what a run's statistics say of its settings; blur pixels are of the smallest and the largest view."""
    plan = config.strategy
    sizes = [view.kept_pixels for view in views]
    return {
        "method": config.method,
        "preset": config.preset,
        "seed": config.seed,
        "lambda_pop": plan.lambda_pop,
        "theta_blur_pixels": [plan.theta_blur * min(sizes), plan.theta_blur * max(sizes)],
        "blur_min_pixels": plan.blur_min_pixels,
        "blur_events": sum(plan.is_blur_step(step) for step in _density_steps(config, plan.refine_every)),
    }


def find_warnings(config: TrainConfig, views: Sequence[ViewTensors]) -> Iterator[str]:
    """Say, in one sentence each, what will not do as it is set, and which option fixes it."""
    plan = config.strategy
    smallest = min(views, key=lambda view: view.kept_pixels)
    pixels = plan.theta_blur * smallest.kept_pixels
    blurs = any(plan.is_blur_step(step) for step in _density_steps(config, plan.refine_every))
    if blurs and max(pixels, plan.blur_min_pixels) < ENOUGH_PIXELS:
        yield (
            f"theta_blur is {pixels:.1f} pixels of {smallest.name} ({smallest.width} x {smallest.height}); it "
            "is 10.7 on the paper's smallest images. Nearly every visible Gaussian will count as blur and grow; "
            f"--{config.method}.blur-min-pixels {ENOUGH_PIXELS} fixes it"
        )
    if config.depth_lambda != 0.0 and not any(view.points is not None and len(view.points) for view in views):
        yield (
            f"depth_lambda is {config.depth_lambda}, but the term has no effect: the capture does not say which "
            "photograph sees which sparse point (COLMAP's tracks); pop sfm and COLMAP write that with the cameras"
        )
    if profile_named(config.profile).principal_point == "centred":
        away = {view.name: _off_centre(view) for view in views}
        worst = max(away, key=lambda name: away[name])
        if away[worst] > ENOUGH_OFF_CENTRE:
            yield (
                f"profile {config.profile} draws with the principal point in the middle of the image, as Inria's code "
                f"does, but that of {worst} is {away[worst]:.1f} pixels away: every photograph is compared with an "
                "image that is shifted by as much; --profile gsplat_1_5 uses the principal point"
            )
    resets = [step for step in _density_steps(config, plan.reset_every) if plan.is_reset_step(step)]
    left = [after - step for step, after in zip(resets, [*resets[1:], config.max_steps], strict=False)]
    if resets and min(left) < RECOVERY_EVENTS * plan.refine_every:
        step = resets[left.index(min(left))]
        yield (
            f"opacities are reset after step {step:,} and have {min(left):,} steps ({min(left) // plan.refine_every} "
            f"densification steps) to recover; 3DGS has {RECOVERY_EVENTS} densification steps; "
            f"--{config.method}.reset-every 0 leaves resets out"
        )


def _off_centre(view: ViewTensors) -> float:
    """Give the distance of the principal point from the middle of the image, px."""
    return math.hypot(float(view.K[0, 0, 2]) - view.width / 2, float(view.K[0, 1, 2]) - view.height / 2)


def _density_steps(config: TrainConfig, every: int) -> range:
    return range(0, min(config.max_steps, config.strategy.refine_stop_iter) if every > 0 else 0, every or 1)
