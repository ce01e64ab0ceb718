"""The written list of laws: `python -m pop_ref.conformance.catalogue > pop_ref/conformance/LAWS.md`."""

from __future__ import annotations

import textwrap
from pathlib import Path

from pop_ref.conformance.backends import ELSEWHERE, SHIPPED
from pop_ref.conformance.capabilities import STAGES
from pop_ref.conformance.mutants.trial import every_law

FILE = Path(__file__).with_name("LAWS.md")
HEAD = """# What the kit asks of a rasterizer

Made by `python -m pop_ref.conformance.catalogue`; a test holds it to the code.

```sh
pip install 'pop-ref[conformance]'
pytest --pyargs pop_ref.conformance --rasterizer my.module:rasterization --profile gsplat_1_6 --scorecard card.html
```

`--rasterizer` names a function with gsplat's signature, `--stages` a package whose modules carry the oracle's function
names, `--adapter` a class derived from `pop_ref.conformance.Adapter`, for single stages or another signature, and
`--backend` an adapter that comes with the kit; what is not installed is skipped with the reason. There are:
BACKENDS

`--profile` says which constants a rasterizer has; `--dtype float64` allows double precision; `--stage compositing`
keeps the laws of one stage; `--unordered-sums` is for a rasterizer that adds in another order on every run, as atomics
do, and skips the laws that compare bits. `HYPOTHESIS_PROFILE` is `quick`, `dev`, `ci` or `thorough`, which draw the
same examples on every machine, or `explore`, which draws anew (`--hypothesis-seed N`). What an implementation does not
offer is skipped by name. A failing law prints the first stage, Gaussian, pixel or gradient that differs, the values on
both sides, the nearest decision with its margin, and a scene to paste, which is also saved as npz (`--failures DIR`;
`scenes.load_scene` reads it). `--scorecard card.html`, or `.json`, sums up by stage.

A rasterizer is asked once for every argument of gsplat's signature: several cameras, batches, packed rows, depth modes,
plain colours of any number of channels, colours of each camera, covariances, radius_clip, planes, no background,
sparse_grad. What it refuses is skipped by name and in its own words: an argument that its signature lacks,
NotImplementedError, a ValueError or TypeError that Python code raises by a statement, a RuntimeError that says
"unsupported" or "not implemented". Any other error, an assertion among them, is a defect: the laws of that argument
report it, and the scorecard counts it as crashed. What it accepts is compared with what the oracle draws of every frame
alone. One that only draws has no gradients to judge. One that refuses harmonics of the third degree is drawn scenes of
the bands that it has; an adapter says so by its attribute `sh_degree`, a program by a word of its greeting.

Every two values of two arguments that are taken alone meet in some call of a covering array (`pairs.py`); images,
gradients and meta of every camera are compared. To refuse two arguments together that are taken alone is a defect, too.
The scorecard says which pairs were compared. A broken law names the fewest arguments on which its call breaks, with
batch entry, camera and pixel, and prints the call to paste.

What is drawn where nothing but an image is asked for may be other code than what also counts. A rasterizer with the
arguments `dominance` and `counts` is judged as training asks it, and a law holds every choice of the two together.

What trains is judged as it trains. A strategy is driven by a script (`strategy_script.py`), as a run drives it: the
prior joins the loss, the backward pass, Adam, statistics, and then the Gaussians change; with one camera and several,
packed and not, with signed and absolute gradients. `pop_ref.methods` says what POP, gsplat, 3DGS, Mini-Splatting,
Taming-3DGS, Speedy-Splat and PUP-3DGS do at every step. `torch_training.training_stages` makes stage functions of a
trainer's strategies, row operations, schedules and optimizers, and `TorchAdapter(stages=...)` takes any such functions.
`--strategy gsplat.strategy:DefaultStrategy` judges somebody's strategy by the laws of training that are about no
method. An engine with an Adam of its own moves the rows by it (`training_stages(package, adam)`). An
engine's own steps are watched, too (`short_training.py`): with rates of 0 they draw photographs, go back, collect and
move nothing, and after each step gradient sums, views, blur flags, dominated pixels, extents and gradients that wait
are the oracle's; so are the sums of passes over photographs.

What training adds where photographs are few or unlike, depth at sparse points, means of opacities and sizes,
exposures, other backgrounds, corrections of cameras, is judged as stage functions of these names, with gradients.

An adapter defines what there is, under the oracle's names, on arrays. With `composite` alone the oracle projects and
lists the splats of whole scenes; a stage function such as `project_means` is judged by its own laws.

```python
import numpy as np
from pop_ref.conformance import Adapter


class Mine(Adapter):  # pytest --pyargs pop_ref.conformance --adapter my.module:Mine --stage compositing
    name, dtype = "mine", np.float32

    def composite(self, splats, lists, width, height, tile_size, background, profile):
        return my_blend(...)  # anything with image [H, W, 3] and T_final [H, W]
```

Programs in other languages are judged over their standard input and output: `--program "./port words"` starts one,
sends it the scenes that laws make, and reads images, ids, transmittance and gradients. `program_adapter.py` states the
protocol, one line of words and raw arrays each way; `tests/port/port.cpp` is a port in C++ that speaks it. Losses,
density control, Adam, single stages, and calls with several cameras and modes of depth cross as functions that a
program offers by name. A program
that ends, hangs (`--program-timeout`) or answers what cannot be read breaks the law that asked, and what it wrote to
standard error is shown.

Where no program can be started there are portable vectors: `pop vectors export DIR` writes scenes with all that is
expected of them, and `DIR/index.json` explains every array and how it is compared; `pop vectors check DIR RESULTS`
does the comparing.

Numbers are compared in units of eps times a magnitude that is computed from absolute values (`tolerances.py` has every
tolerance beside the worst case that was measured); integers exactly; at a threshold a backend must equal one of the
oracle's outcomes with the decisions near their thresholds taken either way.
"""


def catalogue() -> str:
    """Return the list as Markdown."""
    laws = every_law().values()
    backends = textwrap.fill(", ".join((*SHIPPED, *ELSEWHERE)) + ".", width=120, break_on_hyphens=False)
    parts = [HEAD.replace("BACKENDS", backends), f"## {len(laws)} laws\n"]
    for stage in STAGES:
        names = sorted(law.name for law in laws if law.stage == stage)
        parts.append(f"### {stage}\n\n" + "\n".join(f"- {name.replace('_', ' ')}" for name in names) + "\n")
    return "\n".join(parts)


if __name__ == "__main__":
    print(catalogue(), end="")
