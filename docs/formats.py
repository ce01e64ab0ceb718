"""docs/FORMATS.md, which is made from the table of file formats in the program.

python docs/formats.py            print it
python docs/formats.py --write    write docs/FORMATS.md
python docs/formats.py --check    exit with 1 when the file holds something else
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from pop_fast.io.formats import FORMATS, Format

PAGE = Path(__file__).resolve().parent / "FORMATS.md"
SIZES = PAGE.parents[1] / "benchmarks" / "results" / "sizes.json"
BUDGETS = SIZES.with_name("budgets.json")
# Mip-NeRF 360, mean of nine scenes: method, dB, MB, source; sizes of the source in bytes are divided by 10^6
PUBLISHED = (
    ("3DGS, 30,000 steps, not compressed", "27.21", "734", "Kerbl et al. 2023, table 1"),
    ("LightGaussian", "27.28", "44.0", "arXiv 2311.17245"),
    ("Compact3DGS, with entropy coding", "27.03", "30.5", "arXiv 2311.13681"),
    ("Reduced 3DGS", "27.10", "30.4", "Papantonakis et al. 2024"),
    ("Compressed 3DGS (Niedermayr et al.)", "26.98", "30.2", "arXiv 2401.02436"),
    ("Self-Organizing Gaussians", "27.08", "40.3", "Morgenstern et al. 2024, `eval-release` of its code"),
    ("CompGS (Navaneet et al.), 16K", "27.03", "18.9", "arXiv 2311.18159"),
    ("RDO-Gaussian", "27.05", "23.5", "results in its code's repository"),
    ("gsplat, 1,000,000 Gaussians, PNG", "27.29", "16.0", "`examples/benchmarks/compression` of gsplat"),
    ("HAC, low rate", "27.30", "15.1", "issue 14 of its code's repository"),
)
_FIELDS = ("centre", "scale", "rotation", "opacity", "colour", "view dependence")

_SMALLER = """## Smaller

| option | what goes |
|---|---|
| `--min-opacity A` | Gaussians with a lower opacity; under 1/255 no picture changes |
| `--crop XMIN YMIN ZMIN XMAX YMAX ZMAX` | those with their centre outside a box in the capture's own world frame |
| `--without-floaters` | those that stand before a camera where nothing was photographed, and veils; the rest is tuned |
| `--final-prune SHARE` | those that contribute least and together make up this share of all blending weights |
| `--max-gaussians N` | all but the N of the highest score |
| `--target-mb M` | what a file of at most M megabytes has no room for: Gaussians of the lowest scores, bands of the \
colours, and digits of their coefficients |

Scores (`--score`) are Speedy-Splat's sensitivity, blending weights or dominated pixels, summed over the training views,
or a guess from opacity and size where no capture is known. `pop train` takes the same options, for the files that
`--export` names.

Where the photographs are at hand, `--target-mb` measures what loses least. Every degree of the colours is tried, those
of a lower one fitted to what the training views show, and the best one with finer and coarser coefficients, where the
format has them. Each is tuned for a few steps, written, read back and measured in training views; the best is tuned for
`--fine-tune-steps` (300; 0 tunes nothing), and so is what `--max-gaussians` keeps. The run's own engine and loss do
that, without density control; how long it takes is told after its first seconds. Held-out views are measured at the end
and decide nothing. Without photographs, Gaussians alone go, those that are least visible.
"""


def page() -> str:
    """Make the page."""
    sizes = [
        ["`ply`", "`.ply`", "PLY as 3DGS writes it", "248", "248", "every program that knows splats"],
        *([f"`{f.name}`", f"`{f.suffix}`", _described(f), *f.size, f.readers] for f in FORMATS.values()),
        ["`html`", "`.html`", "a page that shows the splat", "4/3 of `spz`", "4/3 of `spz`", "browsers with WebGL 2"],
    ]
    losses = [["`ply`", *["none"] * len(_FIELDS)]]
    losses += [[f"`{f.name}`", *(f.losses[field] for field in _FIELDS)] for f in FORMATS.values()]
    return f"""# File formats

`pop export RESULT --to FORMAT` and `pop convert IN OUT` write these; every command that takes a splat reads them, the
page apart. KSPLAT (`.ksplat`, `github.com/mkkellogg/GaussianSplats3D`) and SOG in a folder (its `meta.json`, or the
folder) are read and not written. `--to spz` writes the version that most programs read, `--to spz-4` the latest one.
Where nobody names the file, no two formats share a name: `scene.spz` and `scene-4.spz`, `scene.glb` and
`scene-spz.glb`. Sizes are in MB, 10^6 bytes. `pop train` ends with the size of the splat in each and the held-out PSNR
when it is read back from there.

{_table(["format", "suffix", "what it is", "bytes a Gaussian, degree 0", "degree 3", "opened by"], sizes)}

## What a round trip changes

Bounds, which the tests hold every format to; opacities are meant activated, scales in world units, colour coefficients
as they are.

{_table(["format", *_FIELDS], losses)}

- An opacity that is stored as a byte comes back between 0.001 and 0.999: a raw opacity has to be finite.
- The order of the Gaussians changes where neighbours in the file should be neighbours in space (`compressed-ply`,
  `spz`, `sog`) and in `.splat`, the largest and most opaque first. Colour degrees that are all zero are left out.
- PLY, compressed PLY, SOG and `.splat` hold the frame as it is, with y down for a capture from COLMAP; SPZ and glTF
  have y up, so that the scene is half a turn about x or z from there. Readers here turn it back.
- Every file but `.splat` says which world the splat is in, the capture's own or the frame that it was trained in, and
  how the one came from the other: PLY and compressed PLY in a comment, SOG in `asset` of its `meta.json`, glTF in
  `extras` of its `asset`, SPZ in an extension of the type 0x504F0001, which other readers skip. A file that says
  nothing is taken to be in the capture's own world, as every export is where `--frame training` does not ask for the
  other; one that gsplat's trainer wrote needs `--training-frame`.
- SPZ is read in versions 2 to 4, also with coordinates that it says to be others (half turns of the usual ones); SOG in
  version 2; glTF as one `.glb` with a splat that no node moves; KSPLAT in version 0.1, all of its compression levels.
- `html` holds SPZ, and loses what that loses. It draws as the training's rasterizer does, to degree 3, but ends no
  pixel early; in the profile `inria` its cut-off is an ellipse of 3 standard deviations and not a square.

{_SMALLER}
## Measured

{_measured(json.loads(SIZES.read_text(encoding="utf-8")))}

## A tenth and a twentieth

{_budgets(json.loads(BUDGETS.read_text(encoding="utf-8")))}
"""


def _measured(sizes: dict[str, Any]) -> str:
    captures, each = sizes["captures"], sizes["ply_bytes"]
    shares = sorted({row["final_prune"] for found in captures.values() for row in found["rows"]})
    head = ["capture", "format", *(f"`--final-prune {share:g}`" if share else "whole" for share in shares)]
    rows, sources = [], []
    for name, found in captures.items():
        whole = found["gaussians"] * each
        sources.append(f"{name}, {found['gaussians']:,} Gaussians, {whole / 1e6:.2f} MB as PLY, {found['psnr']:.2f} dB")
        cells = {
            (row["format"], row["final_prune"]): f"{row['bytes'] / 1e6:.2f} MB, 1/{whole / row['bytes']:.1f}, "
            f"{row['psnr'] - found['psnr']:+.2f} dB"
            for row in found["rows"]
        }
        formats = dict.fromkeys(row["format"] for row in found["rows"])
        rows += [[name, f"`{format}`", *(cells[format, share] for share in shares)] for format in formats]
    return f"""Bytes, their share of the whole splat's PLY, and the change of the held-out PSNR. POP,
`--preset quick --lr.beta2 0.999`, as `quick` was when this was measured:
{"; ".join(sources)}. Every file is written by `pop export` and measured by `pop eval`
(`benchmarks/sizes.py`).

{_table(head, rows)}"""


def _budgets(record: dict[str, Any]) -> str:
    head = ["capture", "format", "bytes", "fewer Gaussians alone", "harmonics and digits too", "and tuned"]
    rows, sources = [], []
    for name, found in record["captures"].items():
        sources.append(
            [
                name,
                str(found["factor"]),
                f"{found['gaussians']:,}",
                f"{found['psnr']:.2f}",
                f"{found['psnr_tuned']:.2f}",
            ]
        )
        for row in found["rows"]:
            cells = [f"{row[kind]['psnr'] - found['psnr']:+.2f} dB" for kind in ("fewer", "spent", "tuned")]
            size = f"{row['bytes'] / 1e6:.2f} MB, 1/{row['share']}"
            rows.append([name, f"`{row['format']}`", size, *cells])
    return f"""Change of the held-out PSNR in a tenth and a twentieth of the bytes of the whole splat's PLY. POP,
`--preset quick` as above, which ends before the splat is as good as it gets: what is tuned can be better than the
whole.
"Fewer Gaussians alone" is what `--target-mb` did before, "harmonics and digits too" is `--fine-tune-steps 0`, the last
column the default of {record["steps"]} steps (`benchmarks/sizes.py --budgets`).

{_table(head, rows)}

The whole splats, and what they come to when they are tuned for the same steps:

{_table(["capture", "photographs shrunk by", "Gaussians", "PSNR, dB", "tuned, dB"], sources)}

Published figures of methods that compress, on another scale: the nine scenes of Mip-NeRF 360, their photographs shrunk
by 4 (outdoors) and 2 (indoors), tens of thousands of steps on a GPU. Each is the authors', as the survey
3DGS.zip (`w-m.github.io/3dgs-compression-survey`, arXiv 2407.09510) lists it, but for the first. They say what
a method reaches there, and nothing about the table above.

{_table(["method", "PSNR, dB", "MB", "source"], [list(row) for row in PUBLISHED])}"""


def _described(format: Format) -> str:
    return f"{format.title}, `{format.source.removeprefix('https://')}`"


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in lines)


def main() -> int:
    """Print, write or check the page."""
    made = page()
    if "--write" in sys.argv:
        PAGE.write_text(made, encoding="utf-8")
        return 0
    if "--check" in sys.argv:
        return 0 if PAGE.is_file() and PAGE.read_text(encoding="utf-8") == made else 1
    print(made, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
