"""Everything a training run is decided by, as one frozen value that goes through JSON and back unchanged.

The numbers are the paper's: 30,000 steps, POP loss and density control to 15,000, blur densification from 3,000 to
7,000. A shorter run keeps the shape of that schedule: `steps_scaler` multiplies every step number in it.

    what                                          scaled
    max_steps                                     yes; the learning rate of the means decays over it, so that scales too
    refine start and stop, reset, blur, POP, L2   yes
    refine_every                                  up only: a shorter schedule has fewer changes, as far apart as ever
                                                  (see `DensityControl.scaled`)
    sh_interval, eval_steps, save_steps           yes
    lambda_pop                                    divided: the prior's push adds up over its steps
    learning rates, other weights, thresholds     no: Adam's step does not depend on the length of a run
    checkpoint_every, log_every                   no: they are about time, not about the schedule
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal

from pop_fast.errors import PopError
from pop_fast.strategies import ADCStrategy, POPStrategy
from pop_fast.train.jsonable import from_plain, to_plain
from pop_fast.train.limits import check_values

QUICK_SCALER: Final = 0.1
PRESETS: Final = {"paper": 1.0, "quick": QUICK_SCALER}
# what theta_blur comes to in the smallest images of the paper (980 x 545); "quick" is for images smaller than those
QUICK_BLUR_MIN_PIXELS: Final = 11.0

# what may differ between a checkpoint and the run that resumes it: it does not reach a single bit of the parameters.
# log_every is not among it: where Gaussians per pixel are counted, tile lists are cut and sums rounded otherwise
_FREE: Final = frozenset(
    {
        *("data", "result_dir", "eval_steps", "save_steps", "checkpoint_every", "keep_checkpoints"),
        *("max_renders", "progress", "lpips_vgg", "lpips_alex", "target_cache_mb"),
    }
)


@dataclass(frozen=True, kw_only=True)
class LearningRates:
    """Adam's learning rates; the means' is in scene scales and decays log-linearly to `means_decay` times itself."""

    means: float = 1.6e-4
    means_decay: float = 0.01
    scales: float = 5e-3
    quats: float = 1e-3
    opacities: float = 5e-2
    sh0: float = 2.5e-3
    sh_rest: float = 2.5e-3 / 20


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Settings of a training run. Step numbers are those of the full schedule, before `steps_scaler`.

    Attributes:
        data: the capture: a COLMAP folder, a folder with transforms.json, or a folder of photographs.
        result_dir: where the run writes.
        method: "pop", or "adc" for plain density control with opacity reset (3DGS as gsplat runs it).
        preset: "paper" is the whole schedule; "quick" a tenth of it, for a CPU, in which a Gaussian must dominate at
            least `QUICK_BLUR_MIN_PIXELS` pixels to count as blur, and none is pruned for its size.
        steps_scaler: multiplies every step number of the schedule; None takes the preset's.
        max_steps: training steps, one view each.
        seed: of the view order, the initial rotations and the split noise.
        backend: what renders and trains: "fast" (CPU), "compiled" (CPU, with kernels in C++), "cuda", "ref" (the
            oracle, slow), or "auto": "cuda" where a GPU and the build are there, else "compiled" where that was
            compiled, else "fast".
        profile: the rasterizer's constants: "paper", "gsplat_1_5", "gsplat_1_6" or "inria".
        antialiased: render with opacity compensation (Mip-Splatting) instead of classically.
        factor: photographs are shrunk by it.
        test_every: every n-th view by file name is held out; 0 holds nothing out.
        background: colour behind everything, and behind photographs with alpha. [0, 1]
        normalize: move the capture into gsplat's normalised world.
        sh_degree: highest band of the colours.
        sh_interval: steps between bands, from band 0 at step 0.
        init_opacity: opacity of the first Gaussians.
        init_scale: multiplies their size, which is the distance to their three nearest neighbours.
        photometric: "l1", "l2", or "method" for the method's own: l2 for pop (paper eq. 9), l1 for adc (eq. 2).
        photometric_divisor: divides the L1 or L2 term, as in the paper's figure of L1/n against L2.
        lambda_ssim: weight of 1 - SSIM; the rest is L1 or L2. None takes the method's own: 0.01 or 0.2.
        l2_stop_iter: step from which eq. 2 (L1, 0.2) takes over; None never, as the paper says of POP alone that it
            ends (A20).
        ssim_padding: "valid" as gsplat, or "same" as 3DGS.
        d_ssim_halved: (1 - SSIM) / 2 instead of 1 - SSIM.
        lr: learning rates.
        pop: the POP strategy's settings.
        adc: plain density control's settings.
        threads: threads of one operation; results are the same bits for the same number. 0 takes all cores.
        eval_steps: after so many steps the held-out views are measured; the last step always counts.
        save_steps: after so many steps a PLY and a checkpoint are kept; the last step always counts.
        checkpoint_every: steps between the checkpoints a run resumes from; 0 writes none of these.
        keep_checkpoints: how many of those are kept.
        log_every: steps between records of metrics.jsonl; such a step also counts what is blended and traversed, which
            doubles its cost.
        max_renders: held-out views saved as pictures at the end.
        lpips_vgg: weights of LPIPS on VGG16: one merged file, or backbone and linear layers; empty for none.
        lpips_alex: weights of LPIPS on AlexNet, likewise.
        target_cache_mb: memory for what SSIM needs of the photographs, kept between steps.
        progress: show a progress bar when standard error is a terminal.
    """

    data: str = ""
    result_dir: str = "results"
    method: Literal["pop", "adc"] = "pop"
    preset: Literal["paper", "quick"] = "paper"
    steps_scaler: float | None = None
    max_steps: int = 30_000
    seed: int = 42
    backend: Literal["auto", "fast", "compiled", "cuda", "ref"] = "auto"
    profile: Literal["paper", "gsplat_1_5", "gsplat_1_6", "inria"] = "paper"
    antialiased: bool = False
    factor: int = 1
    test_every: int = 8
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    normalize: bool = True
    sh_degree: int = 3
    sh_interval: int = 1000
    init_opacity: float = 0.1
    init_scale: float = 1.0
    photometric: Literal["method", "l1", "l2"] = "method"
    photometric_divisor: float = 1.0
    lambda_ssim: float | None = None
    l2_stop_iter: int | None = None
    ssim_padding: Literal["valid", "same"] = "valid"
    d_ssim_halved: bool = False
    lr: LearningRates = field(default_factory=LearningRates)
    pop: POPStrategy = field(default_factory=POPStrategy)
    adc: ADCStrategy = field(default_factory=ADCStrategy)
    threads: int = 0
    eval_steps: tuple[int, ...] = (7_000, 30_000)
    save_steps: tuple[int, ...] = (7_000, 30_000)
    checkpoint_every: int = 1_000
    keep_checkpoints: int = 2
    log_every: int = 25
    max_renders: int = 12
    lpips_vgg: tuple[str, ...] = ()
    lpips_alex: tuple[str, ...] = ()
    target_cache_mb: int = 1024
    progress: bool = True

    def __post_init__(self) -> None:
        check_values(self)

    @property
    def scaler(self) -> float:
        """What the schedule is multiplied by."""
        return PRESETS[self.preset] if self.steps_scaler is None else self.steps_scaler

    @property
    def strategy(self) -> POPStrategy | ADCStrategy:
        """The settings of the method that was chosen."""
        return self.pop if self.method == "pop" else self.adc

    def photometric_at(self, step: int) -> tuple[Literal["l1", "l2"], float]:
        """Return the pixel-wise loss of a step and the weight of 1 - SSIM; the rest of the weight, to 1, is its own."""
        if self.l2_stop_iter is not None and step >= self.l2_stop_iter:
            return "l1", 0.2
        pop = self.method == "pop"
        weight = self.lambda_ssim if self.lambda_ssim is not None else 0.01 if pop else 0.2
        return self.photometric if self.photometric != "method" else "l2" if pop else "l1", weight

    def resolved(self) -> TrainConfig:
        """Return the same run with the scaler worked into every step number (and itself 1)."""
        by = self.scaler
        pop, adc = self.pop.scaled(by), self.adc.scaled(by)
        if self.preset == "quick":
            # what a big Gaussian covered, a sky above all, does not grow back in so few steps: see benchmarks/NOTES.md
            pop, adc = replace(pop, prune_too_big=False), replace(adc, prune_too_big=False)
            pop = replace(pop, blur_min_pixels=max(pop.blur_min_pixels, QUICK_BLUR_MIN_PIXELS))

        def scaled(step: int) -> int:
            return max(round(step * by), 1)

        return replace(
            self,
            preset="paper",
            steps_scaler=None,
            max_steps=scaled(self.max_steps),
            sh_interval=scaled(self.sh_interval),
            l2_stop_iter=None if self.l2_stop_iter is None else scaled(self.l2_stop_iter),
            eval_steps=tuple(scaled(step) for step in self.eval_steps),
            save_steps=tuple(scaled(step) for step in self.save_steps),
            pop=pop,
            adc=adc,
        )

    def to_json(self) -> str:
        """Write the settings as JSON, in reading order."""
        return json.dumps(to_plain(self), indent=2) + "\n"

    @classmethod
    def from_json(cls, text: str) -> TrainConfig:
        """Read what `to_json` wrote; fields that are absent keep their default.

        Raises:
            PopError: not JSON, an unknown field, or a value of the wrong type; names the field.
        """
        try:
            plain = json.loads(text)
        except json.JSONDecodeError as error:
            raise PopError(f"config is not JSON: {error.msg} at line {error.lineno}, column {error.colno}") from error
        except (ValueError, RecursionError) as error:
            raise PopError(f"config is not JSON that can be read: {error}") from error
        return from_plain(cls, plain, "config")

    def binding(self) -> dict[str, Any]:
        """Return the settings that a resumed run must share, flat, step numbers as they are run."""
        plain = to_plain(self.resolved())
        flat: dict[str, Any] = {}
        other = "adc" if self.method == "pop" else "pop"
        for name, value in plain.items():
            if name in _FREE or name == other:
                continue
            flat |= {f"{name}.{key}": v for key, v in value.items()} if isinstance(value, dict) else {name: value}
        return flat

    def digest(self) -> str:
        """Hash the settings that decide the result's bits."""
        return hashlib.sha256(json.dumps(self.binding(), sort_keys=True).encode()).hexdigest()


def first_difference(ours: dict[str, Any], theirs: dict[str, Any]) -> tuple[str, Any, Any] | None:
    """Return the first setting in which two `binding()`s differ, with both values, or None."""
    for name in [*ours, *(name for name in theirs if name not in ours)]:
        if ours.get(name) != theirs.get(name):
            return name, ours.get(name), theirs.get(name)
    return None
