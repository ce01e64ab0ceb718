"""What a splat measures in each file format: bytes against held-out PSNR, whole, pruned and within a budget.

    python benchmarks/sizes.py out/fox out/bonsai --json benchmarks/results/sizes.json
    python benchmarks/sizes.py out/fox out/bonsai --budgets --json benchmarks/results/budgets.json

Every file is written by `pop export` and measured by `pop eval`, as a user would. A result of the same capture that the
JSON already holds is replaced, others are kept. `python docs/tables.py --write` puts the tables into docs/FORMATS.md.

A budget is a tenth and a twentieth of the PLY's bytes. For every format and budget: fewer Gaussians alone, those of the
highest sensitivity, found by the search that export used before it had budgets; `--target-mb --fine-tune-steps 0`,
which spends harmonics and rounding too; and `--target-mb`, which also trains what is left. The whole splat is measured
as it is and after as many steps as the last kind takes, because its training may not have been at its end.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import torch

from benchmarks.record import machine, markdown, read_json, write_json
from pop_fast.children import module_command
from pop_fast.cli.options import LimitOptions
from pop_fast.data import to_capture_frame
from pop_fast.density import shrink
from pop_fast.density.passes import Passes
from pop_fast.io.formats import FORMATS, encoded, save_as
from pop_fast.train.compact import TRIAL, Tuner
from pop_fast.train.load_result import CaptureOptions, load_splat, open_capture
from pop_fast.train.results import read_config
from pop_fast.train.views import ViewTensors, evenly

RESULTS: Final = Path(__file__).resolve().parent / "results"
PLY_BYTES: Final = 248
# of all blending weights, what --final-prune takes away
SHARES: Final = (0.0, 0.002, 0.003)
_NAMES: Final = tuple(name for name in FORMATS if name not in ("gltf", "gltf-spz"))
# of the bytes of the whole splat's PLY
BUDGETS: Final = (10, 20)
# training views that Gaussians are scored over, at most, as by `pop export`
_SCORED: Final = 100
# of `Format.losses`
_FIELDS: Final = ("centre", "scale", "rotation", "opacity", "colour", "view dependence")


def pop(*arguments: str) -> None:
    """Run the command line; its words go to standard error."""
    subprocess.run(module_command("pop_fast.cli", *arguments), check=True, stdout=sys.stderr)


def measured(splat: Path, folder: Path, *options: str) -> dict[str, Any]:
    """Measure a splat as `pop eval` does: PSNR, Gaussians and the rest of its JSON."""
    pop("eval", str(splat), *options, "--json", str(folder / "eval.json"))
    return dict(json.loads((folder / "eval.json").read_text(encoding="utf-8")))


def rows(result: Path, shares: tuple[float, ...] = SHARES) -> Iterator[dict[str, Any]]:
    """Export and measure a result in every format and with every share pruned.

    Yields:
        format, final_prune, gaussians, bytes, psnr.
    """
    run = read_config(result)
    capture = ["--capture", run.data, "--own-frame", "--factor", str(run.factor)]
    for share in shares:
        for name in _NAMES:
            with TemporaryDirectory() as scratch:
                file = Path(scratch) / f"splat{FORMATS[name].suffix}"
                prune = ["--final-prune", str(share)] if share else []
                pop("export", str(result), "--to", name, "--out", str(file), *prune)
                stats = measured(file, Path(scratch), *capture)
                yield {
                    "format": name,
                    "final_prune": share,
                    "gaussians": stats["num_GS"],
                    "bytes": file.stat().st_size,
                    "psnr": stats["psnr"],
                }


def in_whole(result: Path, whole: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Measure a result in every format and with every share pruned, and give what is known of it."""
    yield {"gaussians": whole["num_GS"], "psnr": whole["psnr"], "rows": list(rows(result))}


def rows_of_budgets(result: Path, names: list[str], steps: int) -> Iterator[dict[str, Any]]:
    """Export and measure a result in every format and budget.

    Yields:
        format, share, bytes, and of each kind ("fewer", "spent", "tuned") bytes, gaussians, psnr.
    """
    splat = load_splat(result)
    capture, config = open_capture(splat, CaptureOptions())
    views = [ViewTensors.of(view) for view in evenly(capture.train_views(config.test_every), _SCORED)]
    scores = shrink.view_scores("sensitivity", Passes.of(config.backend, views, config), splat.params, splat.sh_degree)
    own = to_capture_frame(splat.params, capture.world_transform)
    given = ["--capture", splat.config.data, "--own-frame", "--factor", str(splat.config.factor)]
    for name in names:
        for share in BUDGETS:
            most = PLY_BYTES * len(scores) // share
            row: dict[str, Any] = {"format": name, "share": share, "bytes": most}
            with TemporaryDirectory() as scratch:
                file = Path(scratch) / f"fewer{FORMATS[name].suffix}"
                kept = shrink.best_within(
                    scores, most, lambda kept, name=name: len(encoded(name, {k: v[kept] for k, v in own.items()}))
                )
                save_as(file, name, {key: value[kept] for key, value in own.items()}, splat.config.antialiased)
                row["fewer"] = _file(file, given)
                for kind, count in (("spent", 0), ("tuned", steps)):
                    file, began = Path(scratch) / f"{kind}{FORMATS[name].suffix}", time.perf_counter()
                    words = ["--target-mb", f"{most / 1e6:.6f}", "--fine-tune-steps", str(count)]
                    pop("export", str(result), "--to", name, "--out", str(file), *words)
                    row[kind] = {"seconds": round(time.perf_counter() - began, 1), **_file(file, given)}
            yield row


def _file(file: Path, given: list[str]) -> dict[str, Any]:
    stats = measured(file, file.parent, *given)
    return {"bytes": file.stat().st_size, "gaussians": stats["num_GS"], "psnr": stats["psnr"]}


def whole_tuned(result: Path, steps: int) -> float:
    """Return the held-out PSNR of the whole splat after the steps of a trial and of fine-tuning."""
    splat = load_splat(result)
    capture, config = open_capture(splat, CaptureOptions())
    tuner = Tuner(splat.params, splat.sh_degree, config, capture, {}, steps, lambda *_: None)
    params = tuner.tuned(tuner.tuned(tuner.whole, round(TRIAL * steps)), steps)
    return tuner.psnr(params, tuner.held_out)


def within_budgets(result: Path, whole: dict[str, Any], names: list[str]) -> Iterator[dict[str, Any]]:
    """Measure a result in every format and budget, and give what is known of it after each."""
    steps = LimitOptions().fine_tune_steps
    entry = {"gaussians": whole["num_GS"], "psnr": whole["psnr"], "psnr_tuned": whole_tuned(result, steps)}
    entry |= {"factor": read_config(result).factor, "rows": []}
    for row in rows_of_budgets(result, names, steps):
        entry["rows"].append(row)
        yield entry


def formats_table() -> str:
    """Make the table of file formats: what each is called, takes and is opened by."""
    rows = [
        ["`ply`", "`.ply`", "PLY as 3DGS writes it", "248", "248", "every program that knows splats"],
        *(
            [f"`{f.name}`", f"`{f.suffix}`", f"{f.title}, `{f.source.removeprefix('https://')}`", *f.size, f.readers]
            for f in FORMATS.values()
        ),
        ["`html`", "`.html`", "a page that shows the splat", "4/3 of `spz`", "4/3 of `spz`", "browsers with WebGL 2"],
    ]
    return markdown(["format", "suffix", "what it is", "bytes a Gaussian, degree 0", "degree 3", "opened by"], rows)


def losses_table() -> str:
    """Make the table of what each format rounds."""
    rows = [["`ply`", *["none"] * len(_FIELDS)]]
    rows += [[f"`{f.name}`", *(f.losses[field] for field in _FIELDS)] for f in FORMATS.values()]
    return markdown(["format", *_FIELDS], rows)


def sizes_table() -> str:
    """Make the table of every capture in every format, whole and pruned, as it was measured."""
    found = read_json(RESULTS / "sizes.json")
    captures, each = found["captures"], found["ply_bytes"]
    shares = sorted({row["final_prune"] for of in captures.values() for row in of["rows"]})
    head = ["capture", "format", *(f"`--final-prune {share:g}`" if share else "whole" for share in shares)]
    rows, sources, commits = [], [], list[str]()
    for name, of in captures.items():
        whole = of["gaussians"] * each
        sources.append(f"{name}, {of['gaussians']:,} Gaussians, {whole / 1e6:.2f} MB as PLY, {of['psnr']:.2f} dB")
        commits.append(of["machine"]["commit"])
        cells = {
            (row["format"], row["final_prune"]): f"{row['bytes'] / 1e6:.2f} MB, 1/{whole / row['bytes']:.1f}, "
            f"{row['psnr'] - of['psnr']:+.2f} dB"
            for row in of["rows"]
        }
        formats = dict.fromkeys(row["format"] for row in of["rows"])
        rows += [[name, f"`{format}`", *(cells[format, share] for share in shares)] for format in formats]
    return f"The whole splats are {'; '.join(sources)}; commits {', '.join(commits)}.\n\n{markdown(head, rows)}"


def budgets_table() -> str:
    """Make the table of captures within budgets: by fewer Gaussians, by rounding too, and tuned."""
    rows, captures = [], read_json(RESULTS / "budgets.json")["captures"]
    for name, found in captures.items():
        for row in found["rows"]:
            cells = [f"{row[kind]['psnr'] - found['psnr']:+.2f} dB" for kind in ("fewer", "spent", "tuned")]
            rows.append([name, f"`{row['format']}`", f"{row['bytes'] / 1e6:.2f} MB, 1/{row['share']}", *cells])
    steps = f"and tuned, {' or '.join(map(str, sorted({of['steps'] for of in captures.values()})))} steps"
    return markdown(["capture", "format", "bytes", "fewer Gaussians alone", "harmonics and digits too", steps], rows)


def tuned_table() -> str:
    """Make the table of the same captures whole, as they were and tuned."""
    rows = [
        [name, str(of["factor"]), f"{of['gaussians']:,}", f"{of['psnr']:.2f}", f"{of['psnr_tuned']:.2f}"]
        for name, of in read_json(RESULTS / "budgets.json")["captures"].items()
    ]
    return markdown(["capture", "photographs shrunk by", "Gaussians", "PSNR, dB", "tuned, dB"], rows)


def main() -> int:
    """Measure results and write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, nargs="+", help="result folders of pop train")
    parser.add_argument("--budgets", action="store_true", help="within a tenth and a twentieth of the PLY's bytes")
    parser.add_argument("--formats", nargs="+", default=["spz", "sog"], help="that files within budgets are written in")
    parser.add_argument("--json", type=Path, required=True, help="where to write")
    args = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    captures = dict(read_json(args.json).get("captures", {}))
    steps = {"steps": LimitOptions().fine_tune_steps} if args.budgets else {}
    for result in args.results:
        with TemporaryDirectory() as scratch:
            whole = measured(result, Path(scratch))
        found = within_budgets(result, whole, args.formats) if args.budgets else in_whole(result, whole)
        for entry in found:
            # with every result, because others are kept that were measured elsewhere
            captures[Path(read_config(result).data).name] = {"machine": machine(), **steps, **entry}
            write_json(args.json, {"ply_bytes": PLY_BYTES, "captures": captures})
    return 0


if __name__ == "__main__":
    sys.exit(main())
