"""Read result folders into what a report shows, and into a row of a table of several results.

Only files in the folder are read; what is absent is left out.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_fast.errors import PopError
from pop_fast.io.atomic import write_file
from pop_fast.io.read_back import check_record, parse_json, read_arrays, read_json
from pop_fast.train.config import TrainConfig
from pop_fast.train.load_result import CaptureRecord, read_record
from pop_fast.train.presets import ALIASES, METHODS, Given, words_of
from pop_fast.train.results import read_commands, read_config
from pop_fast.view.document import Window
from pop_fast.view.report.checks import read_checks
from pop_fast.view.report.model import Finding, Histogram, ReportData, ReportView, Tile, verdict
from pop_fast.view.report.page import page

# float32 numbers of a Gaussian: as gsplat's checkpoints hold it, and as Inria's PLY does (with three zero normals)
BYTES_CKPT: Final = 59 * 4
BYTES_PLY: Final = 62 * 4
_AGAIN: Final = "remove the file, or train again"
_COUNTS: Final = {"counts": ("iu", 1)}
_VIEW: Final = {
    "name": ("U", 0),
    "render": ("u", 3),
    "photo": ("u", 3),
    "psnr": ("f", 0),
    "ssim": ("f", 0),
    "dominant_ids?": ("i", 2),
}
_DEPTH: Final = {"name": ("U", 0), "depth": ("f", 2)}
_SMOOTH: Final = 0.03  # width of the running means, as a share of the records


def read_result(folder: Path, capture: Path | None = None) -> ReportData:
    """Read all that the report shows of a result folder; its commands name `capture` where that has moved."""
    config = read_config(folder)
    records = read_records(folder)
    stats = read_last_stats(folder)
    method = METHODS[config.method].title
    histograms = list(_histograms(folder, config.max_steps))
    shown = [read_view(path) for path in _last_view_files(folder)]
    changes = [record for record in records if "cloned" in record or "reset" in record]
    curves, checks = _curves(records, folder), None
    measured = _numbered(folder / "report_data", r"checks_step(\d+)\.json")
    # a run that was checked where it stopped, and went on, has later statistics
    if measured and measured[-1][0] >= (stats.get("step") or 0):
        checks = read_checks(measured[-1][1])
    viewer = folder / "viewer.html"
    fix = "train again with --resume, which measures them"
    entries = checked_encodings(stats.get("encodings") or [], str(folder), fix)
    held_out = held_out_views(stats["views"]) if stats.get("views") else ""
    return ReportData(
        title=f"{Path(config.data).resolve().name} · {method.split(' (')[0]}",
        subtitle=" · ".join(filter(None, [method, _schedule_note(config), held_out, _machine(stats)])),
        headline=headline(stats),
        curves=curves,
        max_steps=config.max_steps,
        windows=_windows(config),
        resets=[int(record["step"]) for record in changes if record.get("reset")],
        histograms=histograms,
        dominant=next(((str(a["name"]), a["dominant_ids"], a["render"]) for a in shown if "dominant_ids" in a), None),
        views=_views(shown, folder, checks is not None),
        n_held_out=stats.get("views"),
        config=_settings(config, folder),
        changes=[{key: change.get(key) for key in _CHANGE_COLUMNS} for change in changes],
        files=encoding_table(entries) if entries else [],
        viewer=_read(viewer).decode("utf-8", "replace") if viewer.is_file() else None,
        verdict=[typed(found, config, folder, capture) for found in verdict(stats, checks, curves.get("psnr_val"))],
        checked=checks is not None,
        orbit=_orbit(folder) if checks is not None else None,
        commands=[(shlex.join(entry["words"]), entry["folder"]) for entry in read_commands(folder)],
        links=list(_links(folder)),
    )


def typed(finding: Finding, config: TrainConfig, folder: Path, capture: Path | None = None) -> Finding:
    """Put capture and folder into the command that a finding ends in; another training is asked for as this one was."""
    if not finding.next:
        return finding
    places = {"DATA": str(capture or config.data), "RESULT": str(folder)}
    words = [places.get(word, word) for word in finding.next]
    record = read_record(folder) or CaptureRecord()
    if words[0] in ("train", "data") and record.images is not None:
        words += ["--images", record.images]
    if words[0] == "train":
        words += _read_again(record)
        # "." has no name to put something behind
        named = folder.resolve() if folder.name in ("", "..") else folder
        words += [*_asked_again(config, finding.next), "--out", f"{named}_next"]
    if words[0] == "export" and capture is not None:
        words += ["--capture", str(capture)]
    return replace(finding, next=tuple(words))


def _read_again(record: CaptureRecord) -> list[str]:
    """Return the options by which a capture was read; its folder of photographs is not among them."""
    words = [] if record.missing == "error" else ["--missing", record.missing]
    words += [] if record.masks else ["--ignore-masks"]
    return words + ([] if record.source == "auto" else ["--source", record.source])


def _asked_again(config: TrainConfig, words: Sequence[str]) -> list[str]:
    """Return the options of a run that a command leaves as they were, where it has these words itself."""
    given = config.given
    if given is None:
        method = [] if config.method == "pop" else ["--method", config.method]
        return method + (["--factor", str(config.factor)] if config.factor > 1 else [])
    names = {word.removeprefix("--").replace("-", "_") for word in words if word.startswith("--")}
    if names & {"steps_scaler", "minutes"}:
        given, names = replace(given, steps_scaler=None), names | _STEP_COUNTS
    # minutes are for a run that chooses its length; that is what no preset means
    again = words_of(given, {*names, *_PLACES})
    if "minutes" in names and given.preset != Given.preset:
        at = again.index("--preset")
        del again[at : at + 2]
    return again


# settings of the folder and the machine, and numbers of steps, which a shorter schedule would not follow
_PLACES: Final = frozenset({"data", "result_dir", "progress", "threads"})
_STEP_COUNTS: Final = frozenset({"max_steps", "eval_steps", "save_steps", "checkpoint_every"})


_CHANGE_COLUMNS: Final = ("step", "cloned", "split", "pruned", "reset", "num_gaussians")


def _orbit(folder: Path) -> tuple[str, bytes] | None:
    numbered = _numbered(folder / "videos", r"orbit_step(\d+)\.webm")
    if not numbered:
        return None
    path = numbered[-1][1]
    return path.relative_to(folder).as_posix(), _read(path)


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise PopError(f"{path}: could not be read: {error.strerror}; remove it, or check its permissions") from error


def _links(folder: Path) -> Iterator[tuple[str, str, int]]:
    """List what is worth opening from the report: the viewer, the last PLY, exports, the orbit."""
    plys = _numbered(folder / "ply", r"point_cloud_(\d+)\.ply")
    films = _numbered(folder / "videos", r"orbit_step(\d+)\.webm")
    exports = sorted((folder / "export").iterdir()) if (folder / "export").is_dir() else []
    named = [
        ("the splat in the browser", folder / "viewer.html"),
        *(("the splat", path) for _, path in plys[-1:]),
        *(("export", path) for path in exports),
        *(("the orbit", path) for _, path in films[-1:]),
        ("settings", folder / "cfg.json"),
        ("records", folder / "metrics.jsonl"),
    ]
    for name, path in named:
        if path.is_file():
            yield name, path.relative_to(folder).as_posix(), path.stat().st_size


def read_records(folder: Path) -> list[dict[str, Any]]:
    """Read metrics.jsonl; a last line that was cut off by a kill is ignored."""
    path = folder / "metrics.jsonl"
    if not path.is_file():
        return []
    lines = path.read_bytes().split(b"\n")
    records: list[dict[str, Any]] = []
    # behind the last line's end stands nothing, or what a kill left of a line
    for number, line in enumerate(lines[:-1], start=1):
        where = f"{path}: line {number}"
        record = parse_json(line.decode("utf-8", "replace"), where, _AGAIN)
        records.append(check_record(record, where, _AGAIN, needed=("step",)))
    return records


def read_last_stats(folder: Path) -> dict[str, Any]:
    """Read the statistics of the last step: the training's, overlaid by those of the held-out views."""
    merged: dict[str, Any] = {}
    for kind in ("train", "val"):
        numbered = _numbered(folder / "stats", rf"{kind}_step(\d+)\.json")
        if numbered:
            merged |= read_stats(numbered[-1][1])
    return merged


def read_stats(path: Path) -> dict[str, Any]:
    """Read one file of statistics."""
    fix = "remove the file; 'pop eval' measures a result again"
    return check_record(read_json(path, fix), str(path), fix)


def read_view(path: Path) -> dict[str, np.ndarray]:
    """Read what a run has kept of a held-out view: its name, render, photo, psnr and ssim."""
    return read_arrays(path, _VIEW, _AGAIN)


def headline(stats: Mapping[str, Any]) -> list[Tile]:
    tiles: list[Tile] = []
    for key, label, form, unit in (("psnr", "PSNR", "{:.2f}", "dB"), ("ssim", "SSIM", "{:.4f}", "")):
        if stats.get(key) is not None:
            tiles.append(Tile(label, form.format(stats[key]), unit, "mean of the held-out views"))
    if stats.get("lpips") is not None:
        tiles.append(Tile("LPIPS", f"{stats['lpips']:.4f}", "", str(stats.get("lpips_net", ""))))
    elif "lpips" in stats:
        tiles.append(Tile("LPIPS", "–", "", str(stats.get("lpips_reason", "not measured"))))
    if stats.get("num_GS") is not None:
        n = int(stats["num_GS"])
        left = stats.get("num_GS_above_floor")
        tiles.append(Tile("Gaussians", f"{n:,}", "", "" if left is None else f"{int(left):,} with opacity ≥ 1/255"))
        as_ply = f"as PLY {n * BYTES_PLY / 1e6:.1f} ({BYTES_PLY} B)"
        tiles.append(Tile("Size", f"{n * BYTES_CKPT / 1e6:.1f}", "MB", f"{BYTES_CKPT} B each; {as_ply}"))
    if stats.get("n_blended") is not None:
        traversed = "" if stats.get("n_traversed") is None else f"{stats['n_traversed']:.1f} traversed"
        tiles.append(Tile("Gaussians per pixel", f"{stats['n_blended']:.1f}", "blended", traversed))
    return tiles + _cost_tiles(stats)


def _cost_tiles(stats: Mapping[str, Any]) -> list[Tile]:
    tiles: list[Tile] = []
    seconds, steps = stats.get("seconds"), stats.get("step")
    if seconds:
        value, unit = (f"{seconds:.0f}", "s") if seconds < 600 else (f"{seconds / 60:.1f}", "min")
        note = "" if steps is None else f"{(steps + 1) / seconds:.1f} iterations a second"
        tiles.append(Tile("Training", value, unit, note))
    if stats.get("memory_bytes"):
        tiles.append(Tile("Peak memory", f"{stats['memory_bytes'] / 1e9:.1f}", "GB", "of the whole process"))
    return tiles


def _machine(stats: Mapping[str, Any]) -> str:
    versions = stats.get("versions") or {}
    torch = f"torch {versions['torch']}" if "torch" in versions else ""
    threads = threads_of(stats) if "threads" in stats else ""
    return ", ".join(filter(None, [str(stats.get("machine") or ""), threads, torch]))


def _schedule_note(config: TrainConfig) -> str:
    steps = f"{config.max_steps:,} iterations"
    given = config.given
    if given is None or given.scaler == 1.0:
        return steps
    return f"{steps} (preset {given.preset}, the paper's schedule times {given.scaler:g})"


def _curves(records: Sequence[Mapping[str, Any]], folder: Path) -> dict[str, tuple[list[float], list[float]]]:
    curves: dict[str, tuple[list[float], list[float]]] = {}
    window = max(1, round(len(records) * _SMOOTH))
    for key in ("num_gaussians", "psnr", "loss", "n_blended", "n_traversed"):
        points = [(float(r["step"]), float(r[key])) for r in records if r.get(key) is not None]
        if points:
            steps, values = (list(column) for column in zip(*points, strict=True))
            name = "psnr_train" if key == "psnr" else key
            curves[name] = steps, values if key == "num_gaussians" else running_mean(values, window)
    files = _numbered(folder / "stats", r"val_step(\d+)\.json")
    measured = [(step, read_stats(path).get("psnr")) for step, path in files]
    held_out = [(float(step + 1), float(psnr)) for step, psnr in measured if psnr is not None]
    if held_out:
        curves["psnr_val"] = [step for step, _ in held_out], [psnr for _, psnr in held_out]
    return {name: thin_out(*curve) for name, curve in curves.items()}


def running_mean(values: Sequence[float], window: int) -> list[float]:
    """Average each value with those before it, `window` in all (fewer at the start), without what is not finite."""
    out: list[float] = []
    for i in range(len(values)):
        part = [v for v in values[max(0, i + 1 - window) : i + 1] if math.isfinite(v)]
        out.append(sum(part) / len(part) if part else math.nan)
    return out


def thin_out(steps: list[float], values: list[float], most: int = 400) -> tuple[list[float], list[float]]:
    """Keep at most about `most` points of a curve, evenly, the first and the last among them."""
    if len(steps) <= most:
        return steps, values
    kept = np.unique(np.round(np.linspace(0, len(steps) - 1, most)).astype(int))
    return [steps[i] for i in kept], [values[i] for i in kept]


def _windows(config: TrainConfig) -> list[Window]:
    plan = config.strategy
    windows = [Window("density control", plan.refine_start_iter, plan.refine_stop_iter, "var(--density)")]
    if plan.blur_stop_iter >= plan.blur_start_iter:
        windows.append(Window("blur densification", plan.blur_start_iter, plan.blur_stop_iter, "var(--blur)"))
    if plan.lambda_pop > 0.0:
        windows.append(Window("POP loss", plan.pop_start_iter, plan.pop_stop_iter, "var(--pop)"))
    last = config.max_steps
    return [replace(window, stop=min(window.stop, last)) for window in windows if window.start < last]


def _histograms(folder: Path, max_steps: int) -> Iterator[Histogram]:
    numbered = _numbered(folder / "report_data", r"opacity_step(-?\d+)\.npz")
    for place, (step, path) in enumerate(numbered):
        counts = read_arrays(path, _COUNTS, _AGAIN)["counts"]
        if len(counts) % 2:
            raise PopError(f"{path}: counts has {len(counts)} bins, which no run writes; {_AGAIN}")
        last = place == len(numbered) - 1 and step + 1 >= max_steps
        title = "start" if step < 0 else "end" if last else f"iteration {step + 1:,}"
        # two of the file's bins make one bar: 50 bars are readable, and 0.1 and 0.9 stay bin edges
        yield Histogram(title, counts.reshape(-1, 2).sum(axis=1))


def _views(shown: Sequence[Mapping[str, Any]], folder: Path, checked: bool) -> list[ReportView]:
    """Order the held-out views, the worst first; their depth was measured where the splat was checked."""
    kept = (read_arrays(path, _DEPTH, _AGAIN) for path in _last_view_files(folder, "depth") if checked)
    depths = {str(found["name"]): found["depth"] for found in kept}
    views = []
    for a in shown:
        name = str(a["name"])
        views.append(ReportView(name, a["render"], a["photo"], float(a["psnr"]), float(a["ssim"]), depths.get(name)))
    return sorted(views, key=lambda view: (view.psnr is None, view.psnr))


def _last_view_files(folder: Path, kind: str = "val") -> list[Path]:
    pattern = re.compile(kind + r"_step(\d+)_(\d+)\.npz")
    data = folder / "report_data"
    found = [(m, p) for p in data.iterdir() if (m := pattern.fullmatch(p.name))] if data.is_dir() else []
    last = max((int(m[1]) for m, _ in found), default=-1)
    return [path for _, path in sorted((int(m[2]), path) for m, path in found if int(m[1]) == last)]


def _numbered(folder: Path, pattern: str) -> list[tuple[int, Path]]:
    if not folder.is_dir():
        return []
    found = ((re.fullmatch(pattern, path.name), path) for path in folder.iterdir())
    return sorted((int(match[1]), path) for match, path in found if match)


def _settings(config: TrainConfig, folder: Path) -> dict[str, Any]:
    given, record = config.given, read_record(folder)
    if given is None:
        return config.flat()
    return {
        "preset": given.preset,
        "steps_scaler": given.scaler,
        "scale_lambda_pop": given.scale_lambda_pop,
        **({"chosen by the run": "; ".join(record.chosen)} if record is not None and record.chosen else {}),
    } | config.flat()


COLUMNS: Final = (
    *("capture", "method", "λ", "steps", "PSNR", "SSIM", "Gaussians", "with opacity ≥ 1/255"),
    *("per pixel: blended / traversed", "opacity > 0.9 / < 0.1", "seconds", "machine"),
)
_TEXT: Final = frozenset({"capture", "method", "machine"})


def row(stats: Mapping[str, Any]) -> list[str]:
    """Write one run's statistics (stats/val_step*.json) as the cells of a row; what is absent becomes a dash."""

    def cell(form: str, *keys: str) -> str:
        values = [stats.get(key) for key in keys]
        return "–" if any(value is None for value in values) else form.format(*values)

    steps = stats.get("step")
    taken, planned = (steps or 0) + 1, stats.get("max_steps")
    unfinished = f" of {planned:,}, unfinished" if isinstance(planned, int) and taken < planned else ""
    method = str(stats.get("method", "–"))
    machine = [str(stats.get("machine", "–")), *([stats["backend"]] if stats.get("backend") else [])]
    machine += [threads_of(stats)] if "threads" in stats else []
    return [
        str(stats.get("capture", "–")),
        METHODS[name].title.split(" (")[0] if (name := ALIASES.get(method, method)) in METHODS else method,
        "–" if not stats.get("lambda_pop") else f"{stats['lambda_pop']:g}",
        "–" if steps is None else f"{taken:,}{unfinished}",
        cell("{:.2f}", "psnr"),
        cell("{:.4f}", "ssim"),
        cell("{:,}", "num_GS"),
        cell("{:,}", "num_GS_above_floor"),
        cell("{:.1f} / {:.1f}", "n_blended", "n_traversed"),
        cell("{:.0%} / {:.0%}", "opacity_above_0.9", "opacity_below_0.1"),
        cell("{:,.0f}", "seconds"),
        ", ".join(machine),
    ]


def threads_of(stats: Mapping[str, Any]) -> str:
    return f"{stats['threads']} thread{'' if stats['threads'] == 1 else 's'}"


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """Lay rows out as a Markdown table, numbers to the right."""
    rule = ["---" if name in _TEXT else "---:" for name in COLUMNS]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (COLUMNS, rule, *rows))


def plain(rows: Sequence[Sequence[str]]) -> str:
    """Lay rows out in columns for a terminal."""
    table = [COLUMNS, *rows]
    widths = [max(len(cells[i]) for cells in table) for i in range(len(COLUMNS))]
    pads = [str.ljust if name in _TEXT else str.rjust for name in COLUMNS]
    padded = ((pad(cell, w) for pad, cell, w in zip(pads, cells, widths, strict=True)) for cells in table)
    return "\n".join("  ".join(cells).rstrip() for cells in padded)


_KINDS: Final[Mapping[str, tuple[type, ...]]] = {
    "format": (str,),
    "bytes": (int,),
    "num_gaussians": (int,),
    "psnr": (int, float, type(None)),
    "views": (int,),
}


def checked_encodings(entries: Any, where: str, fix: str) -> list[dict[str, Any]]:
    """Check the entry `encodings` of the statistics."""
    if not isinstance(entries, list):
        raise PopError(f"{where}: encodings is {type(entries).__name__}; it must be a list; {fix}")
    for index, entry in enumerate(entries):
        wrong = [
            name
            for name, kinds in _KINDS.items()
            if not isinstance(entry, dict) or name not in entry or not isinstance(entry[name], kinds)
        ]
        if wrong:
            raise PopError(f"{where}: encodings[{index}].{wrong[0]} is absent or of the wrong kind; {fix}")
    return entries


def encoding_table(encodings: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Lay encodings out: heads, and a row a format.

    A row is name, MB, bytes a Gaussian, share of the PLY's size, and where views were held out PSNR and how far it is
    from the PLY's. Few of many held-out views are rendered, and the last head says how many.
    """
    views = max((entry["views"] for entry in encodings), default=0)
    rows = [("format", "MB", "B/Gaussian", "of the PLY", f"PSNR of {held_out_views(views)}")]
    whole = next((entry for entry in encodings if entry["format"] == "ply"), None)
    for entry in encodings:
        share = f"1/{whole['bytes'] / max(entry['bytes'], 1):.1f}" if whole else ""
        psnr = "" if entry["psnr"] is None else f"{entry['psnr']:.2f} dB"
        if entry is not whole and whole and None not in (entry["psnr"], whole["psnr"]):
            psnr += f" ({entry['psnr'] - whole['psnr']:+.2f})"
        each = f"{entry['bytes'] / max(entry['num_gaussians'], 1):.1f}"
        rows.append((entry["format"], f"{entry['bytes'] / 1e6:.2f}", each, share, psnr))
    return rows if views else [row[:-1] for row in rows]


def held_out_views(count: int) -> str:
    """Say how many views are held out."""
    return f"{count} held-out view{'' if count == 1 else 's'}"


def write_report(result_dir: str | Path, capture: Path | None = None) -> Path:
    """Write report.html into a result folder, from the files in it alone, and return its path.

    Its commands name `capture` where that is not where training found it.
    """
    folder = Path(result_dir)
    # a name that is no text is shown with escapes
    target = folder / "report.html"
    write_file(target, page(read_result(folder, capture)).encode("utf-8", "backslashreplace"))
    return target
