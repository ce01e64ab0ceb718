"""The written list of laws and mutants: `python -m pop_ref.conformance.catalogue > pop_ref/conformance/LAWS.md`."""

from __future__ import annotations

from pathlib import Path

from pop_ref.conformance.law import STAGES
from pop_ref.conformance.mutants import MUTANTS
from pop_ref.conformance.mutants.trial import every_law

FILE = Path(__file__).with_name("LAWS.md")
HEAD = """# What the kit asks of a rasterizer

Made by `python -m pop_ref.conformance.catalogue`; a test holds it to the code.

```sh
pip install 'pop-splatting[conformance]'
pytest --pyargs pop_ref.conformance --rasterizer my.module:rasterization --profile gsplat_1_6 --scorecard card.html
```

`--rasterizer` names a function with gsplat's signature, `--stages` a package whose modules carry the oracle's function
names; either will do. `--stage compositing` keeps the laws of one stage, `--dtype float64` charges double precision,
`--failures DIR` saves the scene of every broken law. `HYPOTHESIS_PROFILE` is `dev`, `ci` or `thorough`. What an
implementation does not offer is skipped by name. A failing law prints the first stage, Gaussian and pixel that differ,
the values on both sides, the nearest decision with its margin, and a scene to paste.

Numbers are compared in units of eps times a magnitude that is computed from absolute values (`tolerances.py` has every
tolerance beside the worst case that was measured); integers exactly; at a threshold a backend must equal one of the
oracle's outcomes with the doubtful decisions taken either way.
"""


def catalogue() -> str:
    """Return the list as Markdown."""
    laws = every_law().values()
    parts = [HEAD, f"## {len(laws)} laws\n"]
    for stage in STAGES:
        names = sorted(law.name for law in laws if law.stage == stage)
        parts.append(f"### {stage}\n\n" + "\n".join(f"- {name.replace('_', ' ')}" for name in names) + "\n")
    parts.append(f"## {len(MUTANTS)} mutants\n\nBroken copies of the oracle, one line each, from bugs that happened.\n")
    rows = [
        f"| {m.name.replace('_', ' ')} | {m.story} | `{m.file}` | {m.law.partition(':')[2].replace('_', ' ')} |"
        for m in MUTANTS
    ]
    parts.append(
        "\n".join(["| mutant | what happened | file | killed by the law |", "| --- | --- | --- | --- |", *rows])
    )
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    print(catalogue(), end="")
