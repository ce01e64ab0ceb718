"""What a splat measures in each file format, whole and pruned: bytes against held-out PSNR.

    python benchmarks/sizes.py out/fox out/bonsai --json benchmarks/results/sizes.json

Every file is written by `pop export` and measured by `pop eval`, as a user would. A result of the same capture that the
JSON already holds is replaced, others are kept. `docs/formats.py` makes the table of docs/FORMATS.md from it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

if __package__ in (None, ""):
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.record import machine, read_json, write_json
from pop_fast.children import module_command
from pop_fast.io.formats import FORMATS

PLY_BYTES: Final = 248
# of all blending weights, what --final-prune takes away
SHARES: Final = (0.0, 0.002, 0.003)
_NAMES: Final = tuple(name for name in FORMATS if name not in ("gltf", "gltf-spz"))


def pop(*arguments: str) -> None:
    """Run the command line; its words go to standard error."""
    subprocess.run(module_command("pop_fast.cli", *arguments), check=True, stdout=sys.stderr)


def resolved(result: Path) -> dict[str, Any]:
    """Return the settings that a result was trained with."""
    return dict(json.loads((result / "cfg.json").read_text(encoding="utf-8"))["resolved"])


def measured(splat: Path, folder: Path, *options: str) -> dict[str, Any]:
    """Measure a splat as `pop eval` does: PSNR, Gaussians and the rest of its JSON."""
    pop("eval", str(splat), *options, "--json", str(folder / "eval.json"))
    return dict(json.loads((folder / "eval.json").read_text(encoding="utf-8")))


def rows(result: Path, shares: tuple[float, ...] = SHARES) -> Iterator[dict[str, Any]]:
    """Export and measure a result in every format and with every share pruned.

    Yields:
        format, final_prune, gaussians, bytes, psnr.
    """
    run = resolved(result)
    capture = ["--capture", run["data"], "--own-frame", "--factor", str(run["factor"])]
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


def main() -> int:
    """Measure results and write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, nargs="+", help="result folders of pop train")
    parser.add_argument("--json", type=Path, required=True, help="where to write")
    args = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    record = read_json(args.json)
    captures = dict(record.get("captures", {}))
    for result in args.results:
        with TemporaryDirectory() as scratch:
            whole = measured(result, Path(scratch))
        entry = {"gaussians": whole["num_GS"], "psnr": whole["psnr"], "rows": list(rows(result))}
        captures[Path(resolved(result)["data"]).name] = entry
        write_json(args.json, {"machine": machine(), "ply_bytes": PLY_BYTES, "captures": captures})
    return 0


if __name__ == "__main__":
    sys.exit(main())
