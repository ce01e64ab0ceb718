"""docs/commands.md: every command, run on the demo capture, with what it printed and the pictures that it made.

python docs/commands.py --write     run all of them (about ten minutes on two cores) and write the page and its pictures
python docs/commands.py --only learn vectors    run these alone, which need no files of others, and write their sections
python docs/commands.py --check     exit with 1 where the page does not have every command, each with its summary
python docs/commands.py --demo out/demo    draw docs/demo.png from what `make demo` has trained

Nothing is typed by hand: the outputs are those of a run, each no longer than a screen.
"""

from __future__ import annotations

import base64
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from matplotlib import pyplot as plt
from PIL import Image
from websockets.sync.client import connect

from paper_repro.cli import COMMANDS as REPRO_COMMANDS
from pop_fast.api.backend import get_backend
from pop_fast.children import module_command
from pop_fast.cli import COMMANDS as OF_POP
from pop_fast.data.gaussians import initialize_params
from pop_fast.data.load import load_capture
from pop_fast.io.images import id_colors
from pop_fast.train.config import TrainConfig
from pop_fast.train.views import ViewTensors, render_view

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
PAGE, PICTURES = DOCS / "commands.md", DOCS / "commands"
DEMO, OF_CHAPTER = DOCS / "demo.png", ROOT / "pop_ref" / "walkthrough" / "trained.png"
OF_REPRO = {name: about for name, (_, about) in REPRO_COMMANDS.items()}
# what a command prints, in its folder
PRINTED = ".printed"
LONGEST = 30  # lines of an output
WIDEST = 900  # px of a picture
# WebGL without a GPU, and inside a container
HEADLESS = ("--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage")
HEADLESS += ("--hide-scrollbars",)
Picture = Callable[[Path, Path], None]


@dataclass(frozen=True)
class Run:
    """A command line, and a picture that it leaves.

    Attributes:
        of: the command's name, as the list of commands has it.
        words: what is typed.
        picture: draws the picture's PNG from the folder that everything runs in; None where text is all.
        caption: of the picture.
        seconds: until it is ended, for a command that serves until then.
    """

    of: str
    words: str
    picture: Picture | None = None
    caption: str = ""
    seconds: float | None = None


def shot(page: str, width: int = WIDEST, height: int = 700, seconds: float = 4.0) -> Picture:
    """Return what photographs a page in a browser.

    Args:
        page: a file of the folder, or the beginning of an address that the command prints.
        width, height: of the window, px.
        seconds: that the page is given to draw itself.
    """

    def take(folder: Path, png: Path) -> None:
        program = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
        if program is None:
            raise SystemExit("the pictures of pages need Chromium: apt install chromium, or set CHROMIUM")
        address = (folder / page).resolve().as_uri()
        if "://" in page:
            address = next(word for word in (folder / PRINTED).read_text().split() if word.startswith(page))
        options = [*HEADLESS, f"--window-size={width},{height}", "--remote-debugging-port=0"]
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
            browser = subprocess.Popen(
                [program, *options, f"--user-data-dir={profile}", address], stderr=subprocess.DEVNULL
            )
            try:
                png.write_bytes(_photographed(Path(profile), seconds))
            finally:
                browser.terminate()
                browser.wait()

    return take


def _photographed(profile: Path, seconds: float) -> bytes:
    """Ask the browser of a profile for a PNG of its page, by the DevTools protocol."""
    port = profile / "DevToolsActivePort"
    for _ in range(100):
        if port.exists():
            break
        time.sleep(0.2)
    time.sleep(seconds)
    with urllib.request.urlopen(f"http://127.0.0.1:{port.read_text().split()[0]}/json/list") as answer:
        page = next(target for target in json.load(answer) if target["type"] == "page")
    with connect(page["webSocketDebuggerUrl"], max_size=None) as wire:
        wire.send(json.dumps({"id": 1, "method": "Page.captureScreenshot"}))
        while (message := json.loads(wire.recv())).get("id") != 1:
            pass
    return base64.b64decode(message["result"]["data"])


def tiles(pattern: str, count: int = 4) -> Picture:
    """Return what puts the first few pictures of a glob next to one another."""

    def join(folder: Path, png: Path) -> None:
        found = [cv2.imread(str(path)) for path in sorted(folder.glob(pattern))[:count]]
        row = cv2.hconcat([image for image in found if image is not None])
        scale = min(1.0, WIDEST / row.shape[1])
        cv2.imwrite(str(png), cv2.resize(row, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))

    return join


RUNS = (
    Run("doctor", "pop doctor"),
    Run("build-cpu", "pop build-cpu"),
    Run("build-cuda", "pop build-cuda --help"),
    Run("demo", "pop demo scene", tiles("scene/images/*.png"), "four of its photographs"),
    Run("data check", "pop data check scene"),
    Run("data check", "pop data check photos"),
    Run("sfm", "pop sfm photos"),
    Run(
        "train", "pop train scene --preset quick --out out/pop", shot("out/pop/report.html", height=1100), "report.html"
    ),
    Run("train", "pop train scene --preset quick --method gsplat --out out/gsplat --skip-checks"),
    Run(
        "train",
        "pop train scene --preset quick --max-steps 500 --blocks 2x1 --out out/blocks",
        tiles("out/blocks/blocks/map.png", 1),
        "blocks/map.png",
    ),
    Run("blocks", "pop blocks merge out/blocks"),
    Run("eval", "pop eval out/pop"),
    Run("render", "pop render out/pop --out views", tiles("views/*.png", 3), "held-out views"),
    Run("render", "pop render out/pop --path orbit --video orbit.webm"),
    Run("view", "pop view out/pop --port 8099", shot("http://127.0.0.1:8099", 1100, 650, 20.0), "in the browser", 60.0),
    Run(
        "explain",
        "pop explain out/pop --view 3 --pixel 80,60 --html why.html",
        shot("why.html", height=1000),
        "why.html",
    ),
    Run("compare", "pop compare out/pop out/gsplat"),
    Run("report", "pop report out/pop"),
    Run("export", "pop export out/pop --out mine.ply --drop-invisible"),
    Run("export", "pop export out/pop --to spz --final-prune 0.003"),
    Run("export", "pop export out/pop --to html", shot("pop.html", 700, 525), "pop.html, drawn by WebGL"),
    Run("convert", "pop convert mine.ply mine.sog"),
    Run("frames", "pop frames orbit.webm --count 12 --out frames", tiles("frames/*.jpg", 4), "four of the frames"),
    Run("learn", "pop learn start mine"),
    Run("learn", "pop learn check alpha mine"),
    Run("learn", "pop learn map mine", tiles("mine/picture.png", 1), "the picture as it stands"),
    Run("vectors", "pop vectors export vectors"),
    Run("vectors", "pop vectors check vectors vectors"),
    Run("completion", "pop completion bash | head -12"),
)
# none reads the package's results: the page would be an old one with each row that is trained
REPRO = (
    Run("run", "pop-repro run pop demo --scale toy --results results --work work"),
    Run("queue", "pop-repro queue --scale toy --rows pop gsplat l2_blur --results results --work work"),
    Run("verify", "pop-repro verify pop demo --scale toy --results results --work work --steps 100"),
    Run("status", "pop-repro status --scale toy --results results --work work"),
    Run("table", "pop-repro table 4 --scale toy --results results --out tables"),
    Run(
        "figure",
        "pop-repro figure 7 --scale toy --results results --work work --out figures",
        tiles("figures/*.png", 1),
    ),
    Run("claims", "pop-repro claims --scale toy --results results"),
    Run("data check", "pop-repro data check --data ."),
)


def sentence(summary: str) -> str:
    """Make a sentence of a command's summary."""
    return f"{summary[0].upper()}{summary[1:]}."


def ran(run: Run, folder: Path) -> str:
    """Run a command line in the folder and return what it printed, errors too."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "110", "PATH": path}
    process = subprocess.Popen(
        run.words, shell=True, cwd=folder, env=environment, text=True, stdin=subprocess.DEVNULL,
        stdout=(folder / PRINTED).open("w"), stderr=subprocess.STDOUT, start_new_session=True,
    )  # fmt: skip
    if run.seconds is not None:
        time.sleep(run.seconds / 4)
        drawn(run, folder)
        os.killpg(process.pid, signal.SIGTERM)
    process.wait()
    return (folder / PRINTED).read_text()


def drawn(run: Run, folder: Path) -> Path | None:
    """Draw a run's picture, once, into its folder of the run's folder; return where it is."""
    if run.picture is None:
        return None
    png = folder / PICTURES.name / (re.sub(r"\W+", "_", f"{run.of} {run.caption}").strip("_") + ".png")
    if not png.exists():
        png.parent.mkdir(exist_ok=True)
        run.picture(folder, png)
        with Image.open(png) as taken:
            small = _png(_in_256_colours(taken))
        png.write_bytes(small)
    return png


def shown(text: str, folder: Path) -> str:
    """Return an output as the page has it: no path of this machine, no more than a screen."""
    names = {folder: ".", folder.resolve(): ".", Path(sys.prefix): ".venv", ROOT: "pop-splatting", Path.home(): "~"}
    for path, name in names.items():
        text = text.replace(str(path), name)
    # the viewer's word is another one each time
    text = re.sub(r"(viewer: http://[^/]+/)[\w-]+/", r"\1WORD/", text)
    lines = [line.rstrip() for line in text.rstrip().splitlines()]
    if len(lines) > LONGEST:
        half = LONGEST // 2
        lines = [*lines[:half], f"... {len(lines) - 2 * half} lines more ...", *lines[-half:]]
    return "\n".join(lines)


def sections(folder: Path, runs: tuple[Run, ...], program: str, commands: dict[str, str]) -> Iterator[str]:
    """Run everything in order, and give a section for every command."""
    before = ""
    for run in runs:
        if run.of != before:
            yield f"## {program} {run.of}\n\n{sentence(commands[run.of])}"
            before = run.of
        print(run.words, file=sys.stderr, flush=True)
        text = shown(ran(run, folder), folder)
        # longer than any fence within, as of what `pop-repro claims` prints
        fence = "`" * max([3, *(len(inner) + 1 for inner in re.findall(r"^`{3,}", text, re.MULTILINE))])
        yield f"{fence}console\n$ {run.words}\n{text}\n{fence}"
        png = drawn(run, folder)
        if png is not None:
            yield f"![{run.caption or run.of}]({PICTURES.name}/{png.name})"


def page() -> str:
    """Run every command, and make the page of it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        subprocess.run(
            module_command("pop_fast.cli", "demo", "bare"), cwd=folder, check=True, env=environment, capture_output=True
        )
        (folder / "bare" / "images").rename(folder / "photos")
        parts = [*sections(folder, RUNS, "pop", OF_POP), *sections(folder, REPRO, "pop-repro", OF_REPRO)]
        # only now: a page that is cut off half made leaves the one that is there, with its pictures
        shutil.rmtree(PICTURES, ignore_errors=True)
        shutil.copytree(folder / PICTURES.name, PICTURES)
    return "\n\n".join([_HEAD, *parts]) + "\n"


def with_sections_of(names: list[str], text: str) -> str:
    """Run some commands in a new folder, and return the page with their sections in the place of those that it has."""
    with tempfile.TemporaryDirectory() as name:
        for program, all_runs, commands in (("pop", RUNS, OF_POP), ("pop-repro", REPRO, OF_REPRO)):
            runs = tuple(run for run in all_runs if run.of in names)
            made = "\n\n".join(sections(Path(name), runs, program, commands))
            for section in filter(None, re.split(r"^(?=## pop)", made, flags=re.M)):
                head = section.partition("\n")[0]
                text, n = re.subn(
                    rf"^{re.escape(head)}\n.*?(?=^## pop|\Z)",
                    lambda _, s=section: s.rstrip() + "\n\n",
                    text,
                    flags=re.M | re.S,
                )
                if n != 1:
                    raise ValueError(f"{PAGE.name} has {n} sections {head!r}; make the whole page with --write")
        if (Path(name) / PICTURES.name).is_dir():
            shutil.copytree(Path(name) / PICTURES.name, PICTURES, dirs_exist_ok=True)
    return text.rstrip() + "\n"


_HEAD = """# Every command

This page shows one run of each command on the demo capture, with its output. Other programs ran at the same time, so
the times are longer than on an idle machine. `pop COMMAND --help` lists the options of a command.
[The guide](guide.md) says in which order to use the commands. The folder `photos` contains the
demo's photographs alone, without their cameras.
`python docs/commands.py --write` makes this page."""


def lacking(text: str) -> list[str]:
    """Return the commands that a page does not show with their summaries."""
    wanted = {"pop": OF_POP, "pop-repro": OF_REPRO}
    return [
        f"{program} {name}"
        for program, commands in wanted.items()
        for name, summary in commands.items()
        if f"## {program} {name}\n\n{sentence(summary)}\n\n```console\n$ {program} {name}"
        not in text.replace("````", "```")
    ]


# The picture of a demo run: one held-out view before training, after it, and as it was photographed. The same render
# and photograph, without a word, are kept for chapter 0 of the walk-through.


def before(result: Path, view: int) -> np.ndarray:
    """Render a held-out view of the Gaussians that training began with. [H, W, 3] in [0, 1]"""
    config = TrainConfig.from_json((result / "cfg.json").read_text(encoding="utf-8"))
    capture = load_capture(config.data, factor=config.factor, normalize=config.normalize)
    params = initialize_params(capture, config.seed, config.init_opacity, config.init_scale)
    with torch.no_grad():
        made = render_view(
            get_backend("fast"), params, ViewTensors.of(capture.test_views(config.test_every)[view]), config, 0
        )
    return made.image.clamp(0.0, 1.0).numpy()


def data_of(result: Path, view: int) -> Path:
    """Find the maps of a held-out view after the last step."""
    return sorted((result / "report_data").glob(f"val_step*_{view:04d}.npz"))[-1]


def side_by_side(result: Path, view: int = 0) -> bytes:
    """Put the render of a held-out view to the left of its photograph; PNG."""
    with np.load(data_of(result, view)) as kept:
        both = np.hstack([kept["render"], kept["photo"]])
    return _png(Image.fromarray(both))


def draw(result: Path, view: int = 0) -> bytes:
    """Compose the picture of one held-out view of a result folder; PNG with 256 colours."""
    with np.load(data_of(result, view)) as kept:
        photo, render, ids = kept["photo"], kept["render"], kept["dominant_ids"]
        psnr = float(kept["psnr"])
    parts = (
        ("before training: one Gaussian a point", before(result, view)),
        (f"after a minute on two cores: {psnr:.1f} dB", render),
        ("the photograph, never seen in training", photo),
        ("the dominant Gaussian of each pixel", id_colors(ids)),
    )
    height, width = photo.shape[:2]
    figure, axes = plt.subplots(1, 4, figsize=(4 * width / 100, (height + 24) / 100), dpi=100)
    for axis, (title, picture) in zip(axes, parts, strict=True):
        axis.imshow(picture, interpolation="nearest")
        axis.set_axis_off()
        axis.text(0.5, -0.03, title, transform=axis.transAxes, ha="center", va="top", fontsize=9, color="#666666")
    figure.subplots_adjust(left=0, right=1, top=1, bottom=24 / (height + 24), wspace=0.02)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", transparent=False)
    plt.close(figure)
    return _png(_in_256_colours(Image.open(buffer)))


def _in_256_colours(picture: Image.Image) -> Image.Image:
    # a third of the bytes
    return picture.convert("RGB").quantize(256, dither=Image.Dither.FLOYDSTEINBERG)


def _png(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def main() -> int:
    """Print, write or check the page, or draw the demo's picture."""
    if "--check" in sys.argv:
        missing = lacking(PAGE.read_text(encoding="utf-8"))
        print("\n".join(missing) or f"{PAGE.name} has every command")
        return int(bool(missing))
    if "--demo" in sys.argv:
        result, *view = sys.argv[sys.argv.index("--demo") + 1 :]
        plt.switch_backend("Agg")
        for target, made in ((DEMO, draw), (OF_CHAPTER, side_by_side)):
            target.write_bytes(made(Path(result), *map(int, view)))
            print(f"{target}: {target.stat().st_size / 1000:.0f} kB")
        return 0
    if "--only" in sys.argv:
        names = sys.argv[sys.argv.index("--only") + 1 :]
        PAGE.write_text(with_sections_of(names, PAGE.read_text(encoding="utf-8")), encoding="utf-8")
        return 0
    if sys.argv[1:] not in ([], ["--write"]):
        print(__doc__)
        return 2
    made = page()
    if "--write" in sys.argv:
        PAGE.write_text(made, encoding="utf-8")
    else:
        print(made, end="")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
