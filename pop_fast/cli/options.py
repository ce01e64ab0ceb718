"""Options of several subcommands: which capture to look at, and what to leave out of a splat on its way into a file."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sized
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

import tyro

from pop_fast.errors import PopError
from pop_fast.io.atomic import write_file
from pop_fast.io.formats import format_names
from pop_fast.io.heartbeat import Heartbeat, bars, duration
from pop_fast.io.ply import Frame
from pop_fast.train.config import TrainConfig
from pop_fast.train.load_result import CaptureOptions, Splat, open_capture

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from pop_fast.data import Capture
    from pop_fast.data.load import Photographs
    from pop_fast.density.shrink import Score
    from pop_fast.train.compact import Compact, Tuner

    FormatName = str
else:
    # what is registered when the program starts
    FormatName = Literal[(*format_names(), "html")]


# views that scores are summed over, at most; of a larger capture, an even selection
_MOST_VIEWS: Final = 100
# bytes of what `--target-mb` counts in
_MEGABYTE: Final = 1_000_000
# of fine-tuning; more is a training
_MOST_STEPS: Final = 30_000


@dataclass(frozen=True, kw_only=True)
class LimitOptions:
    """Which Gaussians go into a file.

    Attributes:
        min_opacity: leave out Gaussians with a lower opacity; 1/255 = 0.0039 changes no picture.
        crop: keep those with their centres in the box XMIN YMIN ZMIN XMAX YMAX ZMAX, in the capture's own world frame.
        without_floaters: leave out those that stand, in the picture of a photograph's camera or of one that turns about
            the subject, nearer than half the distance of the nearest sparse points there: haze and veils. Those that
            reach into such a picture from outside, and hide more of the turn than they show of the photographs, go
            too where the rest can be tuned on the photographs.
        final_prune: leave out those that contribute least and together make up this share of all blending weights in
            the training views, as 0.003, and those that no training view shows.
        max_gaussians: keep at most so many, those of the highest scores.
        target_mb: make a file of at most so many megabytes (10^6 bytes): by fewer Gaussians, those of the highest
            scores, and where photographs are at hand also by a lower degree and a coarser encoding of the colours,
            whatever loses least in the training views.
        fine_tune_steps: after max_gaussians, target_mb or without_floaters, train what is left for so many steps on the
            photographs, if they are at hand; 0 leaves it as it is.
        score: what `max-gaussians` and `target-mb` go by: "sensitivity" is Speedy-Splat's, "contributions" the blending
            weights, "dominance" the pixels dominated, each over all training views; "visibility" is opacity and size
            alone; "auto" is sensitivity where a capture is known, otherwise visibility.
    """

    min_opacity: float | None = None
    crop: tuple[float, float, float, float, float, float] | None = None
    without_floaters: bool = False
    final_prune: float | None = None
    max_gaussians: int | None = None
    target_mb: float | None = None
    fine_tune_steps: int = 300
    score: Literal["auto", "contributions", "dominance", "sensitivity", "visibility"] = "auto"

    @property
    def any(self) -> bool:
        limits = (self.min_opacity, self.crop, self.final_prune, self.max_gaussians, self.target_mb)
        return self.without_floaters or any(limit is not None for limit in limits)

    def check(self) -> None:
        """Refuse what cannot be before anything is loaded."""
        if self.min_opacity is not None and not 0.0 <= self.min_opacity <= 1.0:
            raise PopError(f"--min-opacity {self.min_opacity:g} must be in [0, 1]")
        if self.crop is not None and not all(a <= b for a, b in zip(self.crop[:3], self.crop[3:], strict=True)):
            raise PopError(f"--crop {self.crop}: give XMIN YMIN ZMIN XMAX YMAX ZMAX, each minimum under its maximum")
        if self.final_prune is not None and not 0.0 <= self.final_prune < 1.0:
            raise PopError(f"--final-prune {self.final_prune:g} must be in [0, 1)")
        if self.max_gaussians is not None and self.max_gaussians < 1:
            raise PopError(f"--max-gaussians {self.max_gaussians} must be at least 1")
        if self.target_mb is not None and not 0.0 < self.target_mb < math.inf:
            raise PopError(f"--target-mb {self.target_mb:g} must be over 0 and finite")
        if not 0 <= self.fine_tune_steps <= _MOST_STEPS:
            raise PopError(f"--fine-tune-steps {self.fine_tune_steps} must be 0 to {_MOST_STEPS:,}")


@dataclass(frozen=True)
class Shown:
    """A splat in its training frame with what it can be scored by."""

    params: dict[str, Tensor]  # raw parameters
    sh_degree: int  # highest active colour band
    config: TrainConfig  # how it is drawn
    world_transform: np.ndarray | None  # the training frame from the capture's; None where they are the same
    # opens its capture, and gives the settings to look at it with; None where none is known
    photographed: Callable[[], tuple[Capture, TrainConfig]] | None
    checkpoint: Path | None = None  # that it was read from, if any
    progress: bool = True  # whether to show how far long work is


@dataclass(frozen=True)
class Output:
    """The file that a splat becomes."""

    name: str  # of its format, or "html"
    antialiased: bool = False  # to be drawn with antialiasing
    frame: Frame | None = None  # the world that the file is in, where it is known
    # what `to_capture_frame` moves the splat into that by; None where nothing moves. [4, 4]
    transform: np.ndarray | None = None
    # makes a page of raw parameters, at a level of coarseness
    page: Callable[[Mapping[str, Tensor], int], bytes] | None = None

    @property
    def levels(self) -> int:
        from pop_fast.io.formats import levels

        return levels(self._format)

    @property
    def _format(self) -> str:
        # what a page holds is SPZ
        return self.name if self.page is None else "spz"

    def write(self, params: Mapping[str, Tensor], level: int = 0) -> bytes:
        """Return the file's bytes; see `pop_fast.train.compact.Coding`."""
        return self._encoded(params, level) if self.page is None else self.page(params, level)

    def shown(self, params: Mapping[str, Tensor], level: int = 0) -> dict[str, Tensor]:
        """Return what is read from the file, in the frame of the parameters."""
        from pop_fast.data import apply_similarity
        from pop_fast.io.formats import decoded

        back = decoded(self._format, self._encoded(params, level)).params
        return back if self.transform is None else apply_similarity(back, self.transform)

    def _encoded(self, params: Mapping[str, Tensor], level: int) -> bytes:
        from pop_fast.data import to_capture_frame
        from pop_fast.io.formats import encoded

        moved = params if self.transform is None else to_capture_frame(dict(params), self.transform)
        return encoded(self._format, moved, self.antialiased, self.frame, level)


@dataclass
class Limited:
    """What limits have left: raw parameters, the level of coarseness to write them at, and what was said of it."""

    params: dict[str, Tensor]
    level: int = 0
    said: list[str] = field(default_factory=list)

    def keep(self, kept: Tensor, what: str) -> None:
        """Keep the Gaussians that are marked; a PopError refuses to keep none."""
        before, after = len(kept), int(kept.sum())
        self.said.append(f"{what}: {after:,} of {before:,} Gaussians kept")
        if after == 0 and before > 0:
            raise PopError(f"{what} leaves no Gaussian of {before:,}; loosen that limit")
        self.params = {name: value[kept] for name, value in self.params.items()}

    def write(self, out: Path, output: Output, progress: bool = True) -> None:
        """Print what was said, write the file, and say how much is in it."""
        for line in self.said:
            print(line, flush=True)
        self.said.clear()
        with Heartbeat(progress) as beat:
            beat.say(f"writing {len(self.params['means']):,} Gaussians to {out.name}")
            data = output.write(self.params, self.level)
        write_file(out, data)
        print(f"{len(self.params['means']):,} Gaussians, {len(data) / 1e6:.2f} MB -> {out}")


def limited(shown: Shown, limits: LimitOptions, output: Output) -> Limited:
    """Leave out what the limits say of the splat that becomes a file; what is left keeps its order."""
    from pop_fast.density import shrink

    left = Limited(shown.params)
    if limits.min_opacity is not None:
        left.keep(shrink.opaque_enough(left.params, limits.min_opacity), f"opacity >= {limits.min_opacity:g}")
    if limits.crop is not None:
        left.keep(shrink.inside(_means_of_capture(left.params, shown), limits.crop), "in the box")
    if limits.without_floaters:
        _leave_out_floaters(left, limits, shown)
    if limits.final_prune is not None:
        kept = shrink.all_but_the_least(_scores(shown, left.params, "contributions"), limits.final_prune)
        left.keep(kept, f"all but {limits.final_prune:.2%} of the blending weights")
    if limits.max_gaussians is None and limits.target_mb is None:
        return left
    by_itself: shrink.Score = "visibility" if shown.photographed is None else "sensitivity"
    score = by_itself if limits.score == "auto" else limits.score
    if limits.max_gaussians is not None:
        before = len(left.params["means"])
        left.keep(shrink.best(_scores(shown, left.params, score), limits.max_gaussians), f"highest {score}")
        if limits.target_mb is None and len(left.params["means"]) == before:
            # where none is left out, there is nothing that the others would have to make up for
            return left
    if shown.photographed is None:
        _fit_unseen(left, limits, output)
    else:
        _fit_seen(left, limits, output, shown, score)
    return left


def _fit_unseen(left: Limited, limits: LimitOptions, output: Output) -> None:
    """Fit a splat without photographs into its bytes, by fewer Gaussians alone: what else would lose is not known."""
    from pop_fast.density import shrink

    if limits.target_mb is None:
        return
    rows, most = left.params, int(limits.target_mb * _MEGABYTE)

    def size(kept: Tensor) -> int:
        return len(output.write({name: value[kept] for name, value in rows.items()}))

    left.keep(shrink.best_within(shrink.visibility(rows), most, size), f"highest visibility in {limits.target_mb:g} MB")


def _fit_seen(left: Limited, limits: LimitOptions, output: Output, shown: Shown, score: Score) -> None:
    """Fit a splat into its bytes by what loses least in its training views, and tune what is left on them."""
    from pop_fast.train import compact

    capture, config, learned = _photographs(shown, left, limits.crop is not None)
    steps = limits.fine_tune_steps
    if learned is None:
        left.said.append(_NOT_TUNED)
        steps = 0
    with _told(shown.progress) as report:
        tuner = compact.Tuner(left.params, shown.sh_degree, config, capture, learned or {}, steps, report)
        if limits.target_mb is None:
            left.params = compact.tuned_to_the_end(tuner) if steps else left.params
            return
        scored = replace(shown, config=config, photographed=lambda: (capture, config))
        found = compact.within(
            tuner, lambda params: _scores(scored, params, score), int(limits.target_mb * _MEGABYTE), output
        )
    before, after = len(left.params["means"]), len(found.params["means"])
    if after == 0 and before > 0:
        raise PopError(f"--target-mb {limits.target_mb:g} leaves no Gaussian of {before:,}; ask for more")
    left.params, left.level = found.params, found.level
    left.said.append(
        f"in {limits.target_mb:g} MB: {after:,} of {before:,} Gaussians, colours of degree {found.degree} of "
        f"{compact.degree_of(tuner.whole)}, written at level {found.level + 1} of {output.levels}"
    )
    left.said.append(_quality(tuner, found, output))


_NOT_TUNED: Final = "not fine-tuned: only the checkpoints hold what the run learned of its photographs"


@contextmanager
def _told(progress: bool) -> Iterator[Callable[[int, int, float | None], None]]:
    """Show how far fine-tuning is, and say once how long it takes."""
    told = False
    with bars(progress) as bar:

        def report(done: int, planned: int, seconds: float | None) -> None:
            nonlocal told
            if seconds is not None and not told:
                told = True
                print(f"fine-tuning: about {duration(seconds)}; --fine-tune-steps 0 skips it", flush=True)
            bar("fine-tuning", done, planned)

        yield report


def _leave_out_floaters(left: Limited, limits: LimitOptions, shown: Shown) -> None:
    """Leave out what stands where floaters do, and where the rest is tuned on the photographs, what veils the orbit.

    Of what a veil leaves out photographs show a little, which the rest has to learn. What grows in front of a camera
    meanwhile is left out at the end.
    """
    if shown.photographed is None:
        raise PopError("finding floaters needs the cameras; give --capture DIR")
    from pop_fast.train import compact
    from pop_fast.train.engines import renderer
    from pop_fast.view.report.checks import are_floaters, are_veils

    steps = limits.fine_tune_steps
    capture, config, learned = _photographs(shown, left, limits.crop is not None)
    degree, backend = shown.sh_degree, renderer(config.backend)[0]
    before, near = left.params, are_floaters(left.params["means"], capture, config.test_every)
    left.keep(~near, "without floaters")
    if learned is None:
        left.said.append(_NOT_TUNED)
    if learned is None or not steps:
        return
    veils = are_veils(before, capture, config, degree, backend)[~near]
    if not veils.any():
        return
    left.keep(~veils, "without veils")
    with _told(shown.progress) as report:
        tuner = compact.Tuner(left.params, degree, config, capture, learned, steps, report)
        left.params = compact.tuned_to_the_end(tuner)
    grown = are_floaters(left.params["means"], capture, config.test_every)
    grown |= are_veils(left.params, capture, config, degree, backend)
    if grown.any():
        left.keep(~grown, "without what grew meanwhile")
    views = tuner.held_out
    where = _named(views)
    after, had = (tuner.psnr(params, views) for params in (left.params, before))
    left.said.append(f"tuned for {steps} steps: PSNR in {where} {after:.2f} dB, with all Gaussians {had:.2f} dB")


def _named(held_out: Sized) -> str:
    """Name the views that are measured: those that are held out, or the training views where none is."""
    from pop_fast.view.report.source import held_out_views

    return held_out_views(len(held_out)) if held_out else "training views"


def _quality(tuner: Tuner, found: Compact, output: Output) -> str:
    """Say how well a file shows the held-out views, or the training views where none is held out."""
    views = tuner.held_out
    where = _named(views)
    before, after = (tuner.psnr(params, views) for params in (tuner.whole, output.shown(found.params, found.level)))
    return f"PSNR of the file in {where}: {after:.2f} dB, of the whole splat {before:.2f} dB"


def _photographs(
    shown: Shown, left: Limited, cropped: bool
) -> tuple[Capture, TrainConfig, Mapping[str, Mapping[str, Tensor]] | None]:
    """Return the capture that a splat is measured by, its settings, and what was learned of its photographs.

    Photographs show what a crop has left out, so that pictures of what is left stand in for them. What was learned is
    None where it is not at hand.
    """
    assert shown.photographed is not None
    capture, config = shown.photographed()
    if cropped:
        from pop_fast.train.compact import with_pictures

        return *with_pictures(capture, left.params, config, shown.sh_degree), {}
    if not (config.exposure or config.refine_cameras):
        return capture, config, {}
    if shown.checkpoint is None or shown.checkpoint.suffix != ".pt":
        return capture, config, None
    from pop_fast.train.checkpoint import load_checkpoint

    learned = load_checkpoint(shown.checkpoint)["appearance"]
    fits = all(len(found["value"]) == len(capture.train_views(config.test_every)) for found in learned.values())
    return capture, config, learned if fits else None


def _means_of_capture(params: dict[str, Tensor], shown: Shown) -> Tensor:
    if shown.world_transform is None:
        return params["means"].double()
    from pop_fast.data import to_capture_frame

    double = {name: value.double() for name, value in params.items()}
    return to_capture_frame(double, shown.world_transform)["means"]


def _scores(shown: Shown, params: Mapping[str, Tensor], score: Score) -> Tensor:
    from pop_fast.density import shrink

    if score == "visibility":
        return shrink.visibility(params)
    if shown.photographed is None:
        raise PopError(f"{score} is summed over the training views; give --capture DIR, or take --score visibility")
    import torch

    from pop_fast.density.passes import Passes
    from pop_fast.train.compact import degree_of
    from pop_fast.train.engines import renderer
    from pop_fast.train.views import ViewTensors, evenly

    capture, config = shown.photographed()
    views = evenly(capture.train_views(config.test_every), _MOST_VIEWS)
    backend, _ = renderer(config.backend)
    device = torch.device(backend.device)
    passes = Passes.of(backend, [ViewTensors.of(view) for view in views], config, device)
    placed = {name: value.to(device) for name, value in params.items()}
    degree = min(shown.sh_degree, degree_of(params))
    return shrink.view_scores(score, passes, placed, degree)


@dataclass(frozen=True, kw_only=True)
class CaptureArguments(CaptureOptions):
    """Which photographs and cameras to use; what is not given is as in training."""

    capture: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """The capture; by default the one it was trained on."""


def open_with_bars(
    splat: Splat, options: CaptureOptions, photographs: Photographs = "all"
) -> tuple[Capture, TrainConfig]:
    """Load the capture that a splat shows under progress bars; see `pop_fast.train.load_result.open_capture`."""
    with bars() as progress:
        return open_capture(splat, options, progress, photographs)
