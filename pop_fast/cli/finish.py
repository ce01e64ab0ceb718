"""What `pop train` does when the last step is taken: exports, the page that shows the splat, the table of sizes."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pop_fast.cli import EXIT_INCOMPLETE, EXIT_INTERRUPTED
from pop_fast.cli.errors import describe
from pop_fast.cli.export import HTML, file_name, say_written
from pop_fast.cli.limits import FormatName, LimitOptions, Output, Shown, limited

if TYPE_CHECKING:
    from torch import Tensor

    from pop_fast.data import Capture
    from pop_fast.train.config import TrainConfig
    from pop_fast.train.load_result import Splat

VIEWER: Final = "viewer.html"
EXPORTS: Final = "export"


@dataclass(frozen=True, kw_only=True)
class FinishOptions(LimitOptions):
    """What is written beside the results.

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


def finish(folder: Path, capture: Capture, options: Any) -> int:
    """Write what surrounds a run whose results are complete, which they stay whatever becomes of it.

    Args:
        folder: the result folder.
        capture: in the training frame.
        options: what has the attributes of `FinishOptions`.

    Returns:
        The exit status: 0, or 1 where something could not be written, or 130 after Ctrl-C.
    """
    left = f"the results in {folder} are complete, and pop export {folder} writes files of them"
    try:
        _finish(folder, capture, FinishOptions(**{f.name: getattr(options, f.name) for f in fields(FinishOptions)}))
    except KeyboardInterrupt:
        print(f"pop: stopped while writing exports; {left}", file=sys.stderr)
        return EXIT_INTERRUPTED
    except Exception as error:
        reason = describe(error) or f"{type(error).__name__}: {error}"
        print(f"pop: error: {reason}; {left}", file=sys.stderr)
        return EXIT_INCOMPLETE
    return 0


def _finish(folder: Path, capture: Capture, options: FinishOptions) -> None:
    from pop_fast.io.atomic import write_atomically
    from pop_fast.io.frame import Frame
    from pop_fast.train.load_result import load_splat
    from pop_fast.view.html import cameras_of, page_of

    splat = load_splat(folder)
    title = folder.resolve().name

    rest = (cameras_of(capture.train_views(splat.config.test_every)), splat.config, splat.sh_degree, title)
    shown = Shown(
        params=splat.params,
        sh_degree=splat.sh_degree,
        config=splat.config,
        world_transform=capture.world_transform,
        photographed=lambda: (capture, splat.config),
        checkpoint=splat.path,
    )
    page = Output(HTML, splat.config.antialiased, page=lambda params, level: page_of(params, *rest, level))
    # what the page and the table of sizes show, and every file whose size is not limited
    kept = limited(shown, dataclasses.replace(options, target_mb=None), page)
    names = options.export or (("ply",) if options.any else ())
    for line in kept.said if names and options.target_mb is None else ():
        print(line)
    frame = Frame("capture", tuple(map(tuple, capture.world_transform.tolist())))
    for name in names:
        output, left = page if name == HTML else Output(name, page.antialiased, frame, capture.world_transform), kept
        if options.target_mb is not None:
            left = limited(shown, options, output)
            for line in left.said:
                print(line)
        path = folder / EXPORTS / file_name(title, name)
        data = output.write(left.params, left.level)
        write_atomically(path, lambda file, data=data: file.write(data))
        say_written(path, len(left.params["means"]), len(data))
    shown_page = page.write(kept.params)
    write_atomically(folder / VIEWER, lambda file: file.write(shown_page))
    if not options.skip_sizes:
        _sizes(folder, splat, capture, kept.params)
    if not options.skip_checks:
        checked(folder, splat, capture, splat.config)


def checked(folder: Path, splat: Splat, capture: Capture, config: TrainConfig) -> None:
    """Render and measure what the report shows besides the results; see `pop_fast.view.report.checks`."""
    from pop_fast.io.heartbeat import Heartbeat
    from pop_fast.train.engines import renderer
    from pop_fast.train.environment import reproducible
    from pop_fast.view.report.checks import write_checks

    backend, _ = renderer(config.backend)
    with reproducible(config.threads), Heartbeat() as beat:
        beat.say("rendering depth and the orbit for the report")
        step = config.max_steps - 1 if splat.step is None else splat.step
        write_checks(folder, capture, splat.params, config, splat.sh_degree, backend, step)


def _sizes(folder: Path, splat: Splat, capture: Capture, params: dict[str, Tensor]) -> None:
    """Measure the encodings, print them and add them to the statistics."""
    from pop_fast.train.engines import renderer
    from pop_fast.train.environment import reproducible
    from pop_fast.train.evaluate import measure_encodings
    from pop_fast.train.results import ResultFolder
    from pop_fast.train.views import ViewTensors
    from pop_fast.view.report.sections import encoding_heads, encoding_rows

    config = splat.config
    views = [ViewTensors.of(view) for view in capture.test_views(config.test_every)]
    backend, _ = renderer(config.backend)
    with reproducible(config.threads):
        found = measure_encodings(backend, params, views, config, splat.sh_degree, capture.world_transform)
        entries = [encoding.entry() for encoding in found]
    for line in table_lines([encoding_heads(entries), *encoding_rows(entries)]):
        print(line)
    results = ResultFolder(folder)
    before = results.read_stats("val", splat.step) if splat.step is not None else None
    if before is not None and splat.step is not None:
        results.write_stats("val", splat.step, {**before, "encodings": entries})


def table_lines(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lay out a table: the first column to the left, the others to the right."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows]
