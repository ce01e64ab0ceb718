"""The written list of laws, LAWS.md, which `docs/tables.py` writes."""

from __future__ import annotations

import textwrap
from pathlib import Path

from pop_ref.conformance.backends import ELSEWHERE, SHIPPED
from pop_ref.conformance.capabilities import STAGES
from pop_ref.conformance.mutants.trial import every_law

FILE = Path(__file__).with_name("LAWS.md")
HEAD = """# What the kit asks of a rasterizer

Made by `python docs/tables.py --write`; a test holds it to the code.

```sh
pip install './pop_ref[conformance]'   # from a clone of pop-splatting
pytest --pyargs pop_ref.conformance --rasterizer my.module:rasterization --profile gsplat_1_6 --scorecard card.html
```

## Who is judged

One option says what is judged. A `--backend` that is not installed is skipped with the reason; what another option
names must be there, or the session ends with one line.

- `--rasterizer` names a function with gsplat's signature.
- `--stages` names a package whose modules have the oracle's function names.
- `--adapter` names a class derived from `pop_ref.conformance.Adapter`, for single stages or another signature.
- `--program` starts a program in any language.
- `--strategy` names a density strategy with gsplat's protocol, such as `gsplat.strategy:DefaultStrategy`. It is judged
  by the laws of training that concern no particular method.
- `--backend` names an adapter that comes with the kit:
BACKENDS

## Options

- `--profile` says which constants a rasterizer has.
- `--dtype float64` allows double precision.
- `--stage compositing` selects the laws of one stage.
- `--unordered-sums` skips the laws that compare bits, for a rasterizer whose sums have another order in every run, as
  with atomics.
- `--scorecard card.html`, or `.json`, writes a summary by stage.
- `HYPOTHESIS_PROFILE` is `quick`, `dev`, `ci` or `thorough`, which draw the same examples on every machine, or
  `explore`, which draws new ones (`--hypothesis-seed N`).

A failing law prints the first stage, Gaussian, pixel or gradient that differs, the values on both sides, and the
nearest decision with its margin. It also prints a scene to paste, and saves it as npz (`--failures DIR`;
`scenes.load_scene` reads it).

## Arguments

The kit first tries every argument of gsplat's signature once: several cameras, batches, packed rows, depth modes,
plain colours of any number of channels, colours of each camera, covariances, radius_clip, planes, no background,
sparse_grad. A refused argument is skipped by name, with the words of the refusal. A refusal is an argument that the
signature lacks, a NotImplementedError, a ValueError or TypeError raised by Python code, or a RuntimeError that says
"unsupported", "not supported", "only supports" or "not implemented". Any other error, including an assertion, is a
defect: the laws of that argument report it, and the scorecard counts it as crashed. For accepted arguments every frame
is compared with the oracle's render of that frame alone. The gradients of a rasterizer without a backward pass are not
judged. A rasterizer that refuses harmonics of the third degree gets scenes with the bands that it has. An adapter
states them by its attribute `sh_degree`, a program by a word of its greeting.

Every two values of two accepted arguments occur together in some call of a covering array (`pairs.py`), which compares
images, gradients and meta of every camera. Refusing a combination of two accepted arguments is a defect, too.
The scorecard lists the pairs that were compared. A failing law reports the smallest set of arguments with which its
call fails, with batch entry, camera and pixel, and prints the call to paste.

A render without statistics may run other code than a render with them. A rasterizer with the
arguments `dominance` and `counts` is judged with both, as in training, and a law compares all four combinations.

## Training

Code that trains is judged while it trains. A script (`strategy_script.py`) calls a strategy as a run does: the
prior is added to the loss, then come the backward pass, Adam and the statistics, and then the Gaussians change. The
scripts have one camera and several, packed rows and not, signed and absolute gradients. `pop_ref.methods` defines what
POP, gsplat, 3DGS, Mini-Splatting, Taming-3DGS, Speedy-Splat and PUP-3DGS do at every step.
`torch_training.training_stages` makes stage functions of a trainer's strategies, row operations, schedules and
optimizers, and `TorchAdapter(stages=...)` takes any such functions. An engine with its own Adam can pass it
(`training_stages(package, adam)`).

An engine's own steps are judged, too (`short_training.py`). With learning rates of 0 they render photographs, go
backward, collect statistics and move nothing. After each step the gradient sums, views, blur flags, dominated pixels,
extents and delayed gradients must be the oracle's, and so must the sums of passes over photographs.

The terms for few or unlike photographs (depth at sparse points, means of opacities and sizes, exposures, other
backgrounds, corrections of cameras) are judged as stage functions of these names, with gradients.

## Adapters, programs and vectors

An adapter defines the functions that an implementation has, under the oracle's names, on arrays. With `composite`
alone the oracle projects and lists the splats of whole scenes; a stage function such as `project_means` is judged by
its own laws.

```python
import numpy as np
from pop_ref.conformance import Adapter


class Mine(Adapter):  # pytest --pyargs pop_ref.conformance --adapter my.module:Mine --stage compositing
    name, dtype = "mine", np.float32

    def composite(self, splats, lists, width, height, tile_size, background, profile):
        return my_blend(...)  # anything with image [H, W, 3] and T_final [H, W]
```

Programs in other languages are judged over their standard input and output. `--program "./port words"` starts one,
sends it the scenes of the laws, and reads images, ids, transmittance and gradients. `program_adapter.py` defines the
protocol: one line of words and raw arrays each way. `tests/port/port.cpp` is a port in C++ that uses it. A program can
offer further functions by name: losses, density control, Adam, single stages, and calls with several cameras and depth
modes. If a program ends, hangs (`--program-timeout`) or gives an answer that cannot be read, the law that asked fails,
and the report shows the program's standard error.

Where no program can be started there are portable vectors: `pop vectors export DIR` writes scenes with all expected
results, `DIR/index.json` explains every array and how it is compared, and `pop vectors check DIR RESULTS`
compares.

## Tolerances

Numbers are compared in units of eps times a magnitude that is computed from absolute values (`tolerances.py` has every
tolerance with the worst case that was measured). Integers are compared exactly. At a threshold a backend must equal
one of the oracle's outcomes, with each decision near its threshold taken either way.
"""


def catalogue() -> str:
    """Return the list as Markdown."""
    laws = every_law().values()
    names = ", ".join((*SHIPPED, *ELSEWHERE)) + "."
    backends = textwrap.indent(textwrap.fill(names, width=118, break_on_hyphens=False), "  ")
    parts = [HEAD.replace("BACKENDS", backends), f"## {len(laws)} laws\n"]
    for stage in STAGES:
        names = sorted(law.name for law in laws if law.stage == stage)
        parts.append(f"### {stage}\n\n" + "\n".join(f"- {name.replace('_', ' ')}" for name in names) + "\n")
    return "\n".join(parts)
