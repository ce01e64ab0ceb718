"""The options that make a splat smaller on its way into a file, and how they are applied."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from pop_fast.errors import PopError
from pop_fast.io.format_registry import format_names

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from pop_fast.data import Capture
    from pop_fast.density.shrink import Score
    from pop_fast.train.config import TrainConfig

    FormatName = str
else:
    # what is registered when the program starts
    FormatName = Literal[(*format_names(), "html")]
# views that scores are summed over, at most; of a larger capture, an even selection
_MOST_VIEWS: Final = 100
# bytes of what `--target-mb` counts in
_MEGABYTE: Final = 1_000_000


@dataclass(frozen=True, kw_only=True)
class LimitOptions:
    """Which Gaussians go into a file.

    Attributes:
        min_opacity: leave out Gaussians with a lower opacity; 1/255 = 0.0039 changes no picture.
        crop: keep those with their centres in the box XMIN YMIN ZMIN XMAX YMAX ZMAX, in the capture's own world frame.
        without_floaters: leave out those that stand, in the picture of a photograph's camera or of one that turns about
            the subject, nearer than half the distance of the nearest sparse points there: haze and veils.
        final_prune: leave out those that contribute least and together make up this share of all blending weights in
            the training views, as 0.003, and those that no training view shows.
        max_gaussians: keep at most so many, those of the highest scores.
        target_mb: keep as many, those of the highest scores, as make a file of at most so many megabytes (10^6 bytes).
        score: what `max-gaussians` and `target-mb` go by: Speedy-Splat's sensitivity, the blending weights
            (contributions) or the pixels dominated (dominance), each over all training views, or opacity and size alone
            (visibility); "auto" is sensitivity where a capture is known, otherwise visibility.
    """

    min_opacity: float | None = None
    crop: tuple[float, float, float, float, float, float] | None = None
    without_floaters: bool = False
    final_prune: float | None = None
    max_gaussians: int | None = None
    target_mb: float | None = None
    score: Literal["auto", "contributions", "dominance", "sensitivity", "visibility"] = "auto"

    @property
    def any(self) -> bool:
        """Tell whether something may be left out."""
        limits = (self.min_opacity, self.crop, self.final_prune, self.max_gaussians, self.target_mb)
        return self.without_floaters or any(limit is not None for limit in limits)

    def check(self) -> None:
        """Refuse what cannot be before anything is loaded.

        Raises:
            PopError: names the option.
        """
        if self.min_opacity is not None and not 0.0 <= self.min_opacity <= 1.0:
            raise PopError(f"--min-opacity {self.min_opacity:g} must be in [0, 1]")
        if self.crop is not None and not all(a <= b for a, b in zip(self.crop[:3], self.crop[3:], strict=True)):
            raise PopError(f"--crop {self.crop}: give XMIN YMIN ZMIN XMAX YMAX ZMAX, each minimum under its maximum")
        if self.final_prune is not None and not 0.0 <= self.final_prune < 1.0:
            raise PopError(f"--final-prune {self.final_prune:g} must be in [0, 1)")
        if self.max_gaussians is not None and self.max_gaussians < 1:
            raise PopError(f"--max-gaussians {self.max_gaussians} must be at least 1")
        if self.target_mb is not None and not self.target_mb > 0.0:
            raise PopError(f"--target-mb {self.target_mb:g} must be over 0")


@dataclass(frozen=True)
class Shown:
    """A splat in its training frame with what it can be scored by.

    Attributes:
        params: raw parameters.
        sh_degree: highest active colour band.
        config: how it is drawn.
        world_transform: the training frame from the capture's; None where they are the same.
        capture: opens its capture; None where none is known.
    """

    params: dict[str, Tensor]
    sh_degree: int
    config: TrainConfig
    world_transform: np.ndarray | None
    capture: Callable[[], Capture] | None


def limited(
    shown: Shown, limits: LimitOptions, size_of: Callable[[dict[str, Tensor]], int]
) -> tuple[dict[str, Tensor], list[str]]:
    """Leave out what the limits say.

    Args:
        shown: the splat.
        limits: the options.
        size_of: bytes of the file that raw parameters in the training frame make.

    Returns:
        Raw parameters of those that stay, in their order, and a line for every limit that left some out.

    Raises:
        PopError: a limit cannot be met, or no Gaussian is left.
    """
    from pop_fast.density import shrink

    params, said = shown.params, list[str]()

    def keep(kept: Tensor, what: str) -> None:
        nonlocal params
        before, after = len(kept), int(kept.sum())
        said.append(f"{what}: {after:,} of {before:,} Gaussians kept")
        if after == 0 and before > 0:
            raise PopError(f"{what} leaves no Gaussian of {before:,}; ask for less")
        params = {name: value[kept] for name, value in params.items()}

    if limits.min_opacity is not None:
        keep(shrink.opaque_enough(params, limits.min_opacity), f"opacity >= {limits.min_opacity:g}")
    if limits.crop is not None:
        keep(shrink.inside(_means_of_capture(params, shown), limits.crop), "in the box")
    if limits.without_floaters:
        keep(~_floaters(shown, params), "without floaters")
    if limits.final_prune is not None:
        kept = shrink.all_but_the_least(_scores(shown, params, "contributions"), limits.final_prune)
        keep(kept, f"all but {limits.final_prune:.2%} of the blending weights")
    if limits.max_gaussians is None and limits.target_mb is None:
        return params, said
    by_itself: shrink.Score = "visibility" if shown.capture is None else "sensitivity"
    score = by_itself if limits.score == "auto" else limits.score
    scores = _scores(shown, params, score)
    if limits.max_gaussians is not None:
        kept = shrink.best(scores, limits.max_gaussians)
        keep(kept, f"highest {score}")
        scores = scores[kept]
    if limits.target_mb is not None:
        most, rows = int(limits.target_mb * _MEGABYTE), params
        kept = shrink.best_within(scores, most, lambda kept: size_of({key: v[kept] for key, v in rows.items()}))
        keep(kept, f"highest {score} in {limits.target_mb:g} MB")
    return params, said


def _means_of_capture(params: dict[str, Tensor], shown: Shown) -> Tensor:
    if shown.world_transform is None:
        return params["means"].double()
    from pop_fast.data import to_capture_frame

    double = {name: value.double() for name, value in params.items()}
    return to_capture_frame(double, shown.world_transform)["means"]


def _floaters(shown: Shown, params: dict[str, Tensor]) -> Tensor:
    """Tell which Gaussians are floaters."""
    if shown.capture is None:
        raise PopError("floaters are found from the places of the photographs; give --capture DIR")
    from pop_fast.view.report.checks import are_floaters

    return are_floaters(params["means"], shown.capture(), shown.config.test_every)


def _scores(shown: Shown, params: dict[str, Tensor], score: Score) -> Tensor:
    """Return the scores of all Gaussians."""
    from pop_fast.density import shrink

    if score == "visibility":
        return shrink.visibility(params)
    if shown.capture is None:
        raise PopError(f"{score} is summed over the training views; give --capture DIR, or take --score visibility")
    import numpy as np
    import torch

    from pop_fast.density.passes import Passes
    from pop_fast.train.gpu_proxy import renderer
    from pop_fast.train.views import ViewTensors

    views = shown.capture().train_views(shown.config.test_every)
    chosen = np.unique(np.linspace(0, len(views) - 1, min(len(views), _MOST_VIEWS)).round().astype(int))
    backend, _ = renderer(shown.config.backend)
    device = torch.device(backend.device)
    passes = Passes.of(backend, [ViewTensors.of(views[i]) for i in chosen], shown.config, device)
    placed = {name: value.to(device) for name, value in params.items()}
    return shrink.view_scores(score, passes, placed, shown.sh_degree)
