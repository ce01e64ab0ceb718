"""`pop export`: a result as one file, or a folder in Inria's layout; and what `pop train` writes when it ends."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import numpy as np
import tyro

from pop_fast.cli import EXIT_INCOMPLETE, EXIT_INTERRUPTED, describe, parse
from pop_fast.cli.options import CaptureArguments, FormatName, LimitOptions, Output, Shown, limited, open_with_bars
from pop_fast.errors import PopError
from pop_fast.io.atomic import check_folder, check_place, write_file
from pop_fast.io.heartbeat import Heartbeat
from pop_fast.io.ply import Frame
from pop_fast.train.config import TrainConfig
from pop_fast.train.load_result import Splat, drawn_in_frame, frame_of_splat, load_splat, read_record
from pop_fast.train.results import ResultFolder

if TYPE_CHECKING:
    from torch import Tensor

    from pop_fast.data import Capture, View

HTML: Final = "html"
_EXAMPLES: Final = """
    pop export out/scene_pop --out scene.ply                 for any viewer, in the capture's own world frame
    pop export out/scene_pop --to sog                        scene_pop.sog, about an eighth of the PLY's size
    pop export out/scene_pop --to html                       scene_pop.html, one page that shows the splat in a browser
    pop export out/scene_pop --to spz --target-mb 5          at most five megabytes
    pop export out/scene_pop --out scene.splat --min-opacity 0.05 --crop -2 -2 -2 2 2 2
    pop export out/scene_pop --out scene_inria --layout inria
"""


@dataclass(frozen=True, kw_only=True)
class Args(LimitOptions, CaptureArguments):
    """Write a splat as one file (docs/FORMATS.md says what each format keeps), or a folder in Inria's layout."""

    splat: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT|CKPT|FILE")]
    """What to export."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE|DIR")] = None
    """A file whose name says the format, or with --layout inria a new folder; by default a file here, named alike."""
    to: FormatName | None = None
    """The format, if the name does not show it; "spz" is version 3, which most programs read, "gltf-spz" a draft."""
    layout: Literal["file", "inria"] = "file"
    """"inria" writes point_cloud/, cameras.json, cfg_args, and held-out renders, as many tools expect."""
    frame: Literal["capture", "training"] | None = None
    """World frame of the output; by default the capture's own for a result, and the file's own for a lone file."""
    drop_invisible: bool = False
    """Leave out Gaussians with opacity under 1/255: no renderer shows them."""
    overwrite: bool = False
    """Replace the file, or a folder that holds only an earlier export."""


def run(argv: Sequence[str]) -> int:
    args = parse(Args, argv, "export", examples=_EXAMPLES)
    args.check()
    if args.layout == "inria":
        return _inria(args)
    out, name = planned_file(args)
    splat = load_splat(args.splat)
    opened = _Opened(splat, args)
    if args.drop_invisible:
        splat = without_invisible(splat)
    output = _output(args, out, name, splat, opened)
    shown = Shown(
        params=splat.params,
        sh_degree=splat.sh_degree,
        config=opened.config,
        world_transform=_training_frame(splat, args) if args.crop is not None else None,
        photographed=opened.capture if opened.known else None,
        checkpoint=splat.path,
    )
    limited(shown, args, output).write(out, output)
    return 0


def _inria(args: Args) -> int:
    if args.out is None or args.to is not None or args.any or args.drop_invisible or args.frame == "training":
        raise PopError(
            "--layout inria writes all Gaussians, in the capture's own frame, into the folder --out; give --out, and "
            "no --to or limits, no --drop-invisible and no --frame training"
        )
    from pop_fast.view.frames import exported_to, write_inria_folder

    keeps = [args.splat] if args.capture is None else [args.splat, args.capture]
    check_folder(args.out, args.overwrite, keeps=keeps, recognise=exported_to(args.out))
    splat = load_splat(args.splat)
    capture, config = open_with_bars(splat, args)
    write_inria_folder(replace(splat, config=config), capture, args.out, args.overwrite)
    print(f"{len(splat.params['means']):,} Gaussians, {len(capture.views)} cameras -> {args.out}")
    return 0


class _Opened:
    """The capture of a splat, loaded when it is first asked for."""

    def __init__(self, splat: Splat, options: CaptureArguments) -> None:
        self._splat, self._options, self._found = splat, options, None
        self.config = drawn_in_frame(splat, options)

    @property
    def known(self) -> bool:
        return self._options.capture is not None or bool(self.config.data and Path(self.config.data).is_dir())

    def capture(self) -> tuple[Capture, TrainConfig]:
        """Return it, in the frame of the splat, and the settings to look at it with."""
        if self._found is None:
            self._found, self.config = open_with_bars(self._splat, self._options)
        return self._found, self.config


def planned_file(args: Args) -> tuple[Path, str]:
    """Return the file to write and its format, which must agree."""
    if args.out is None and args.to is None:
        raise PopError("nothing to write; give --out FILE or --to FORMAT")
    if args.out is None:
        stem = args.splat.resolve().name
        out = Path(file_name(stem if args.splat.is_dir() else stem.split(".")[0], str(args.to)))
    else:
        out = args.out
    name = file_format(out, args.to)
    if name == HTML and args.frame is not None:
        raise PopError(f"{out}: a page has no frame of its own; leave --frame out")
    check_file(out, args.splat, args.overwrite)
    return out, name


def file_name(stem: str, to: str) -> str:
    """Return the name of a file in a format that `--to` takes, if it is not given."""
    from pop_fast.io.formats import default_name

    return f"{stem}.html" if to == HTML else default_name(stem, to)


def file_format(out: Path, to: str | None) -> str:
    """Return the format that a file is to be written in, by its name or as `--to` says; they must agree."""
    from pop_fast.io.formats import named_format

    is_page = out.suffix.lower() in (".html", ".htm")
    if is_page != (to == HTML) and to is not None:
        raise PopError(f"{out}: a page ends in .html, but --to is {to}; make them agree")
    return HTML if is_page else named_format(out, to)


def note_lost_frame(out: Path, name: str, frame: Frame | None) -> None:
    """Say on stderr that a file does not say its world, or how it is drawn, where what is taken for that is another."""
    from pop_fast.io.formats import loses_frame, loses_settings

    if name == HTML or frame is None:
        return
    if loses_frame(name, frame):
        what = f"{name} cannot record that it is in the training frame"
        print(f"note: {out}: {what}; commands that read it need --training-frame", file=sys.stderr)
    if loses_settings(name, frame):
        settings = ", ".join(f"{setting} {value}" for setting, value in frame.drawn)
        what = f"{name} cannot record that its run drew it with {settings}"
        print(f"note: {out}: {what}; programs that read it draw it as usual", file=sys.stderr)


def _note_coarse_places(out: Path, transform: np.ndarray) -> None:
    """Say on stderr that a capture's coordinates are too large for the numbers of a file, as those of a map."""
    farthest = float(np.abs(np.linalg.inv(transform)[:3, 3]).max())
    step = float(np.spacing(np.float32(farthest)))
    # of the cameras' distance, which is 1 in the training frame
    if step * np.cbrt(np.linalg.det(transform[:3, :3])) > 1e-4:
        what = f"the scene is {farthest:.2g} from the origin of the capture's coordinates, where numbers of files have"
        print(f"note: {out}: {what} steps of {step:.2g}; --frame training keeps all that was trained", file=sys.stderr)


def check_file(out: Path, source: Path, overwrite: bool) -> None:
    """Refuse a file that is not to be replaced, or is the splat itself."""
    if out.is_dir():
        raise PopError(f"{out}: a folder of this name is in the way; choose another name")
    if out.exists() and source.exists() and out.samefile(source):
        raise PopError(f"{out}: is the input file; choose another name")
    if out.exists() and not overwrite:
        raise PopError(f"{out}: exists; pass --overwrite or choose another name")
    check_place(out)


def _output(args: Args, out: Path, name: str, splat: Splat, opened: _Opened) -> Output:
    if name == HTML:
        views = opened.capture()[0].train_views(opened.config.test_every) if opened.known else ()
        return page_output(views, opened.config, splat.sh_degree, args.splat)
    transform, frame = _output_frame(splat, args)
    note_lost_frame(out, name, frame)
    if transform is not None and frame is not None and frame.name == "capture":
        _note_coarse_places(out, transform)
    return Output(name, splat.config.antialiased, frame, transform)


def page_output(views: Sequence[View], config: TrainConfig, sh_degree: int, source: Path) -> Output:
    """Return the page of a splat, which starts at cameras of these views, or where there are none sees most of it."""
    from pop_fast.view.html import cameras_of, page_of

    rest = (cameras_of(views), config, sh_degree, source.resolve().name)
    return Output(HTML, config.antialiased, page=lambda params, level: page_of(params, *rest, level))


def _output_frame(splat: Splat, args: Args) -> tuple[np.ndarray | None, Frame | None]:
    """Return the similarity [4, 4] into the file's frame, or None where nothing moves; and that frame, where known."""
    now, transform = frame_of_splat(splat, args), known_transform(splat, args)
    wanted = args.frame or ("capture" if splat.folder is not None else now)
    if wanted is None or wanted == (now or "capture"):
        return None, None if wanted is None else Frame(wanted, _rows(transform), splat.config.drawn)
    if transform is None:
        transform = _loaded_transform(splat, args)
    frame = Frame(wanted, _rows(transform), splat.config.drawn)
    return transform if wanted == "capture" else np.linalg.inv(transform), frame


def _training_frame(splat: Splat, args: Args) -> np.ndarray | None:
    """Return the training frame from the capture's; None where the splat is in the capture's own frame."""
    if frame_of_splat(splat, args) != "training":
        return None
    known = known_transform(splat, args)
    return _loaded_transform(splat, args) if known is None else known


def _loaded_transform(splat: Splat, args: Args) -> np.ndarray:
    as_trained = replace(splat, frame=Frame("training"))
    return open_with_bars(as_trained, replace(args, own_frame=False, training_frame=False))[0].world_transform


def known_transform(splat: Splat, args: CaptureArguments) -> np.ndarray | None:
    """Return what moves the capture's own frame into the training frame, where the file or its run says. [4, 4]"""
    if splat.frame is not None and splat.frame.transform is not None:
        return np.array(splat.frame.transform)
    record = read_record(splat.folder)
    if args.capture is not None or record is None or not splat.config.normalize:
        return None
    return np.array(record.world_transform)


def _rows(transform: np.ndarray | None) -> tuple[tuple[float, ...], ...] | None:
    return None if transform is None else tuple(map(tuple, transform.tolist()))


def without_invisible(splat: Splat) -> Splat:
    """Leave out Gaussians that no renderer shows, and say how many there were."""
    from pop_fast.train.evaluate import ALPHA_FLOOR

    kept = splat.params["opacities"].sigmoid() >= ALPHA_FLOOR
    before, after = len(kept), int(kept.sum())
    print(f"opacity >= 1/255: {after:,} of {before:,} Gaussians kept, {before - after:,} left out")
    return replace(splat, params={name: value[kept] for name, value in splat.params.items()})


VIEWER: Final = "viewer.html"
EXPORTS: Final = "export"


@dataclass(frozen=True, kw_only=True)
class FinishOptions(LimitOptions):
    """What is written next to the results.

    Attributes:
        export: also write the splat in these formats into the result's folder export, in the capture's own frame. The
            limits below hold for these files, for the table of sizes and for the page; the checkpoint and the PLY stay
            whole.
        skip_sizes: do not measure what the splat weighs in every format.
        skip_checks: do not render what only the report shows: depth, the orbit, floaters, exposure, overfitting.
    """

    export: tuple[FormatName, ...] = ()
    skip_sizes: bool = False
    skip_checks: bool = False


def finish(folder: Path, capture: Capture, options: Any, progress: bool = True) -> int:
    """Write what surrounds a run whose results are complete; see `after_results`."""
    own = FinishOptions(**{f.name: getattr(options, f.name) for f in fields(FinishOptions)})
    left = f"the results in {folder} are complete; the same command writes the rest, pop train with --resume"
    return after_results(
        lambda: _finish(folder, capture, own, progress), "writing what surrounds the results", "", left
    )


def after_results(write: Callable[[], object], doing: str, failed: str, left: str) -> int:
    """Write something next to results that are complete, which they stay whatever becomes of it.

    Returns:
        The exit status: 0, or 1 where it could not be written, or 130 after Ctrl-C.
    """
    try:
        write()
    except KeyboardInterrupt:
        print(f"pop: stopped while {doing}; {left}", file=sys.stderr)
        return EXIT_INTERRUPTED
    except Exception as error:
        # a fault of the program too: the command that writes it by itself shows where it is
        reason = describe(error) or f"{type(error).__name__}: {error}"
        print(f"pop: error: {failed}{reason}; {left}", file=sys.stderr)
        return EXIT_INCOMPLETE
    return 0


def _finish(folder: Path, capture: Capture, options: FinishOptions, progress: bool) -> None:
    splat = load_splat(folder)
    shown = Shown(
        params=splat.params,
        sh_degree=splat.sh_degree,
        config=splat.config,
        world_transform=capture.world_transform,
        photographed=lambda: (capture, splat.config),
        checkpoint=splat.path,
        progress=progress,
    )
    page = page_output(capture.train_views(splat.config.test_every), splat.config, splat.sh_degree, folder)
    # what the page and the table of sizes show, and every file whose size is not limited
    kept = limited(shown, replace(options, target_mb=None), page)
    names = options.export or (("ply",) if options.any else ())
    frame = Frame("capture", _rows(capture.world_transform), splat.config.drawn)
    for name in names:
        output, left = page if name == HTML else Output(name, page.antialiased, frame, capture.world_transform), kept
        if options.target_mb is not None:
            left = limited(shown, options, output)
        out = folder / EXPORTS / file_name(folder.resolve().name, name)
        note_lost_frame(out, name, frame)
        left.write(out, output, progress)
    write_file(folder / VIEWER, page.write(kept.params))
    if not options.skip_sizes:
        with Heartbeat(progress) as beat:
            beat.say("measuring the splat in every file format")
            _sizes(folder, splat, capture, kept.params)
    if not options.skip_checks:
        checked(folder, splat, capture, splat.config, progress)


def checked(folder: Path, splat: Splat, capture: Capture, config: TrainConfig, progress: bool = True) -> None:
    """Render and measure what the report shows besides the results; see `pop_fast.view.report.checks`."""
    from pop_fast.train.engines import renderer
    from pop_fast.train.environment import reproducible
    from pop_fast.view.report.checks import write_checks

    backend, _ = renderer(config.backend)
    with reproducible(config.threads), Heartbeat(progress) as beat:
        beat.say("rendering depth and the orbit for the report")
        step = config.max_steps - 1 if splat.step is None else splat.step
        write_checks(folder, capture, splat.params, config, splat.sh_degree, backend, step)


def _sizes(folder: Path, splat: Splat, capture: Capture, params: dict[str, Tensor]) -> None:
    """Measure the encodings, print them and add them to the statistics."""
    from pop_fast.train.engines import renderer
    from pop_fast.train.environment import reproducible
    from pop_fast.train.evaluate import measure_encodings
    from pop_fast.train.views import ViewTensors
    from pop_fast.view.report.source import encoding_table

    config = splat.config
    views = [ViewTensors.of(view) for view in capture.test_views(config.test_every)]
    backend, _ = renderer(config.backend)
    with reproducible(config.threads):
        found = measure_encodings(backend, params, views, config, splat.sh_degree, capture.world_transform)
        entries = list(found)
    print("\n".join(table_lines(encoding_table(entries))))
    results = ResultFolder(folder)
    before = results.read_stats("val", splat.step) if splat.step is not None else None
    if before is not None and splat.step is not None:
        results.write_stats("val", splat.step, {**before, "encodings": entries})


def table_lines(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lay out a table: the first column to the left, the others to the right."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows]
