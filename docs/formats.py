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

| option | what it removes |
|---|---|
| `--min-opacity A` | Gaussians with a lower opacity; below 1/255 no picture changes |
| `--crop XMIN YMIN ZMIN XMAX YMAX ZMAX` | Gaussians with their centre outside a box in the capture's own world frame |
| `--without-floaters` | Gaussians that float in front of a camera where nothing was photographed, and veils; \
the rest is tuned |
| `--final-prune SHARE` | the Gaussians that contribute least and together make up this share of all blending weights |
| `--max-gaussians N` | all but the N Gaussians with the highest scores |
| `--target-mb M` | whatever does not fit into M megabytes: Gaussians with the lowest scores, bands of the colours, \
digits of their coefficients |

A score (`--score`) is Speedy-Splat's sensitivity, the blending weights or the dominated pixels, summed over the
training views. Without a capture it is an estimate from opacity and size. `pop train` takes the same options for the
files that `--export` names.

With the photographs, `--target-mb` searches for the smallest loss. It tries every degree of the colours (lower degrees
are fitted to the training views), and the best degree with finer and coarser coefficients, if the format has them. Each
candidate is tuned for a few steps, written, read back and measured in training views. The best one is tuned for
`--fine-tune-steps` (300; 0 turns tuning off), and so is the result of `--max-gaussians`. Tuning uses the run's own
engine and loss, without density control, and prints its duration after the first seconds. Held-out views are measured
only at the end and decide nothing. Without photographs `--target-mb` only removes the least visible Gaussians.
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

`pop export RESULT --to FORMAT` and `pop convert IN OUT` write these formats. Every command that takes a splat reads
them, except `html`. KSPLAT (`.ksplat`, `github.com/mkkellogg/GaussianSplats3D`) and SOG in a folder (its `meta.json`,
or the folder) can be read but not written. `--to spz` writes the version that most programs read, `--to spz-4` the
latest version. Default file names differ between formats: `scene.spz` and `scene-4.spz`, `scene.glb` and
`scene-spz.glb`. Sizes are in MB, 10^6 bytes. At its end `pop train` prints the size of the splat in each format, and
the held-out PSNR of the splat read back from that file.

{_table(["format", "suffix", "what it is", "bytes a Gaussian, degree 0", "degree 3", "opened by"], sizes)}

## What a round trip changes

The table gives bounds that the tests enforce for every format. They apply to activated opacities, scales in world
units and unchanged colour coefficients.

{_table(["format", *_FIELDS], losses)}

- An opacity stored as a byte is read back between 0.001 and 0.999, because a raw opacity has to be finite.
- The order of the Gaussians changes in `compressed-ply`, `spz` and `sog`, which place neighbours in space next to each
  other, and in `.splat`, which has the largest and most opaque first. Colour degrees that are all zero are left out.
- PLY, compressed PLY, SOG and `.splat` keep the frame, with y down for a capture from COLMAP. SPZ and glTF have y up,
  so the scene is rotated by half a turn about x or z. The readers of this package rotate it back.
- Every file except `.splat` records whether the splat is in the capture's own world or in the training frame, and the
  transformation between them: PLY and compressed PLY in a comment, SOG in `asset` of its `meta.json`, glTF in `extras`
  of its `asset`, SPZ in an extension of type 0x504F0001, which other readers skip. A file without this record is taken
  to be in the capture's own world. Exports are in that world unless `--frame training` is given. A file that gsplat's
  trainer wrote needs `--training-frame`.
- These versions are read: SPZ 2 to 4, also when it declares other coordinates (half turns of the usual ones); SOG 2;
  glTF as one `.glb` whose nodes do not move the splat; KSPLAT 0.1 with all of its compression levels.
- `html` contains SPZ and has the losses of SPZ. It draws like the training's rasterizer, up to degree 3, but does not
  end pixels early. In the profile `inria` its cut-off is an ellipse of 3 standard deviations instead of a square.

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
    return f"""Cells give the size, its share of the whole splat's PLY, and the change of the held-out PSNR. The runs
are POP with `--preset quick --lr.beta2 0.999`, which was `quick` at the time:
{"; ".join(sources)}. `pop export` wrote every file and `pop eval` measured it
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
    return f"""The table gives the change of the held-out PSNR at a tenth and a twentieth of the whole splat's PLY,
for POP with `--preset quick` as above. This preset ends before the splat has converged, so a tuned file can be better
than the whole splat. "Fewer Gaussians alone" is what `--target-mb` did before, "harmonics and digits too" is
`--fine-tune-steps 0`, and the last column is the default of {record["steps"]} steps (`benchmarks/sizes.py --budgets`).

{_table(head, rows)}

The whole splats, before and after tuning for the same number of steps:

{_table(["capture", "photographs shrunk by", "Gaussians", "PSNR, dB", "tuned, dB"], sources)}

The next table has published figures of compression methods in another setting: the nine scenes of Mip-NeRF 360, with
photographs shrunk by 4 (outdoors) and 2 (indoors), and tens of thousands of steps on a GPU. All but the first are the
authors' figures as the survey 3DGS.zip lists them (`w-m.github.io/3dgs-compression-survey`, arXiv 2407.09510). They
cannot be compared with the table above.

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
