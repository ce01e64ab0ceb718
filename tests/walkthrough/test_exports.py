"""The other forms of the chapters: notebooks, slides that turn and fit, a printed book, and their command.

Notebooks hold the chapter, run in Jupyter, and every picture appears; the first nine need no torch.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy
import pytest

import pop_ref
from pop_ref.learn.course import COURSE
from pop_ref.walkthrough.builder import command
from pop_ref.walkthrough.builder.chapter import Chapter, ChapterError, chapter_number, read_chapter
from pop_ref.walkthrough.builder.command import main
from pop_ref.walkthrough.builder.layout import asset, book, document
from pop_ref.walkthrough.builder.notebooks import notebook
from pop_ref.walkthrough.builder.slides import FILE, chapters_of, deck, read_slides
from pop_ref.walkthrough.pages import Outcome, run_chapter
from pop_ref.walkthrough.widgets import html
from tests.browser import SCREENSHOTS, Page, keep
from tests.walkthrough.conftest import CHAPTERS, MISSING, executed, ran, run_of

TEXT = """# minutes: 5

# %% [markdown]
# # 1. Title
#
# What the reader will know. And more of it; see [the other](chapter_02_other.py).
#
# ## A section
#
# The first sentence, with $a. B$ and POP paper, eq. 11, in it. The second. What leads on is this:
#
# $$x = y$$
#
# - one item
# - another

# %%
import matplotlib.pyplot as plt

from pop_ref.walkthrough.pages import picture

fig, ax = plt.subplots()
ax.plot([0, 1])
picture(fig, "A line with $y$.")
x = 2
x + 1

# %% [markdown]
# ### Exercise 1: predict
# What is two?

# %% answer
# It is 2.
two = 2
print("two")
assert two == x

# %% [markdown]
# ## Another section
#
# It has a widget and a label, D5.
#
# {{source: pop_ref.alpha.falloff}}
#
# {{source: pop_ref.pixel.composite_pixel}}
#
# {{widget: stack}}
#
# And on.
"""


def _small() -> Chapter:
    return read_chapter(Path("chapter_01_small.py"), TEXT)


@pytest.fixture(scope="module")
def small() -> tuple[Chapter, list[Outcome]]:
    return _small(), run_chapter(_small())


SLIDES = """# A title

What it is about.

Notes, 1 minute.
Say hello.

---
# A section

The first, with $a. B$ and D5 in it.

{{picture: 1: A li}}

- one item

Notes, 2 minutes.
More of it.

With two paragraphs.

---
# Play

{{widget: stack}}

Notes, 87 minutes.
Let them play.
"""


def _deck(small: tuple[Chapter, list[Outcome]], text: str = SLIDES) -> str:
    return deck(read_slides(text), lambda number: {"1": small}[number])


def test_a_slide_has_its_text_picture_and_widget_and_its_notes_tell_the_minute(
    small: tuple[Chapter, list[Outcome]],
) -> None:
    text = _deck(small)
    sections = re.findall(r'<section class="slide \w+".*?</section>', text, re.DOTALL)
    faces, notes = zip(*(section.split("<aside>") for section in sections), strict=True)
    assert "<h1>A title</h1>" in faces[0]
    assert "<h2>A section</h2>" in faces[1]
    assert faces[1].index("D5") < faces[1].index("<figcaption>A line with <span") < faces[1].index("one item")
    assert 'data-widget="stack"' in faces[2]
    assert "<p>With two paragraphs.</p>" in notes[1]
    assert [re.findall(r"Minute (\d+ to \d+)", each) for each in notes] == [["0 to 1"], ["1 to 3"], ["3 to 90"]]
    assert not re.search(r'href="(?!#)', text)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("Notes, 2 minutes.", "Notes:", "slides.md:9: a slide is '# Heading', markdown, a line 'Notes, 4 minutes.'"),
        ("1: A li", "1: A circle", "slides.md:9: 0 pictures of chapter 1 have a caption that begins with 'A circle'"),
        ("$a. B$", "$\\nosuchthing{x}$", "slides.md:9: a formula cannot be set"),
    ],
)
def test_a_slide_out_of_form_is_named_with_its_line(
    small: tuple[Chapter, list[Outcome]], old: str, new: str, told: str
) -> None:
    assert SLIDES.count(old) == 1
    with pytest.raises(ChapterError, match=re.escape(told)):
        _deck(small, SLIDES.replace(old, new))


def test_the_lecture_has_25_slides_for_ninety_minutes_and_something_to_say_at_each() -> None:
    slides = read_slides(FILE.read_text(encoding="utf-8"))
    assert len(slides) == 25
    assert sum(slide.minutes for slide in slides) == 90
    for slide in slides:
        assert 60 * slide.minutes >= len(slide.notes.split()) >= 40, slide.heading
        assert len(re.sub(r"\{\{.*?\}\}", "", slide.body).split()) <= 70, slide.heading
    played = [slide for slide in slides if "{{widget: " in slide.body]
    assert len(played) == 4
    assert chapters_of(slides) <= {chapter_number(path) for path in CHAPTERS}


def test_slides_turn_by_key_button_and_finger_and_show_notes(
    page: Page, small: tuple[Chapter, list[Outcome]], tmp_path: Path
) -> None:
    file = tmp_path / "slides.html"
    file.write_text(_deck(small), encoding="utf-8")
    page.open(file, width=1280, height=720)
    here = "[...document.querySelectorAll('.slide')].findIndex(each => getComputedStyle(each).display !== 'none')"
    assert page.ask(here) == 0
    for key, then in (("ArrowRight", 1), (" ", 2), ("End", 2), ("ArrowRight", 2), ("ArrowLeft", 1), ("Home", 0)):
        page.press(key)
        assert page.ask(here) == then, key
    page.ask("document.querySelector('[data-go=\"1\"]').click()")
    assert page.ask(here) == 1
    assert page.ask("location.hash") == "#2"
    notes = "getComputedStyle(document.querySelector('.slide.here aside')).display"
    assert page.ask(notes) == "none"
    page.press("n")
    assert page.ask(notes) == "block"
    page.open(file, width=400, height=700)
    # what scrolls by itself would take a swipe for its own
    turned = "each => getComputedStyle(each).touchAction"
    parts = "document.querySelectorAll('.slide.here, .slide.here .face, .slide.here .body')"
    assert page.ask(f"[...new Set([...{parts}].map({turned}))]") == ["pan-y pinch-zoom"]
    page.touch((300, 300), (100, 310))
    assert page.ask(here) == 1
    page.touch((100, 300), (300, 310))
    assert page.ask(here) == 0
    assert page.complaints == []


@pytest.mark.slow
def test_every_slide_of_the_lecture_fits_its_screen(page: Page, tmp_path: Path) -> None:
    slides = read_slides(FILE.read_text(encoding="utf-8"))
    told = {chapter_number(path): ran(path) for path in CHAPTERS if chapter_number(path) in chapters_of(slides)}
    file = tmp_path / "slides.html"
    file.write_text(deck(slides, told.__getitem__), encoding="utf-8")
    page.open(file, width=1280, height=720)
    for number in range(1, len(slides) + 1):
        page.ask("new Promise(done => setTimeout(() => done(1), 120))")
        face = "document.querySelector('.slide.here .face')"
        assert page.ask(f"{face}.scrollHeight <= {face}.clientHeight + 1"), page.ask(f"{face}.textContent.slice(0, 80)")
        inside = (
            "each => each.getBoundingClientRect().bottom <= innerHeight + 1 && each.getBoundingClientRect().top >= -1"
        )
        assert page.ask(f"[...{face}.querySelectorAll('.body > *')].every({inside})"), page.ask(f"{face}.textContent")
        if SCREENSHOTS or number == 1:
            keep(page.picture(".slide.here .face"), f"slide_{number:02}.png")
        page.press("PageDown")
    assert page.complaints == []


def test_the_book_holds_every_chapter_and_no_id_twice(small: tuple[Chapter, list[Outcome]]) -> None:
    chapter, outcomes = small
    other = read_chapter(Path("chapter_02_other.py"), TEXT.replace("# # 1. Title", "# # 2. Other"))
    text = book([(chapter, outcomes), (other, run_chapter(other))])
    assert text.count("<article id=") == 3
    # answers stand at the back, behind every question
    assert text.rindex("What is two?") < text.index('<article id="answers">') < text.index('<span class="n">two</span>')
    assert text.count("The answer is at the back.") == 2
    assert '<a href="#chapter_02_other">2. Other</a>' in text
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert {each for each in ids if ids.count(each) > 1} == set()
    for used in re.findall(r'(?:href="#|url\(#)([^")]+)', text):
        assert used in ids, used
    assert not re.search(r'href="(?!#)', text)


def test_the_book_prints_what_the_course_asks_for_behind_the_questions_and_a_mistake_where_it_is_looked_for() -> None:
    asked = "# {{source: pop_ref.alpha.sigma_at_pixel}}\n#\n# {{bug: no_half_in_the_exponent}}\n"
    chapter = read_chapter(Path("chapter_01_small.py"), TEXT.replace("# It has a widget", f"{asked}# It has a widget"))
    text = book([(chapter, run_chapter(chapter))])
    questions, answers = text.split('<article id="answers">')
    right = "0.5</span> <span"
    assert "The oracle's <code>sigma_at_pixel</code> is at the back.</a>" in questions
    assert re.search(r"<code>sigma_at_pixel</code>, <code>pop_ref/alpha\.py</code></h3><pre", answers)
    assert right in answers
    assert right not in questions
    assert "with one mistake" in questions
    assert "with one mistake" not in answers


def test_a_training_in_a_book_is_drawn_before_the_page_is_loaded(page: Page, tmp_path: Path) -> None:
    # what is printed is the page as it is when it has loaded, and a worker answers later
    early = "<script>early = [...document.querySelectorAll('dd')].map(each => each.textContent)</script>"
    text = document("A book", html("train") + early, asset("page.css"), attributes=' class="book"')
    (tmp_path / "book.html").write_text(text, encoding="utf-8")
    page.open(tmp_path / "book.html")
    assert page.complaints == []
    assert page.ask("early.filter(each => / dB$/.test(each))") == ["10.3 dB", "10.3 dB"]


@pytest.mark.skipif(command.chromium() is None, reason="there is no Chromium here (apt install chromium)")
def test_the_command_prints_a_book(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--pdf", str(tmp_path / "new" / "book.pdf"), "--only", "1"]) == 0
    assert [path.name for path in tmp_path.rglob("*.*")] == ["book.pdf"]
    whole = (tmp_path / "new" / "book.pdf").read_bytes()
    assert whole.startswith(b"%PDF-")
    assert len(re.findall(rb"/Type\s*/Page\b", whole)) >= 4
    assert "book.pdf" in capsys.readouterr().out


def test_without_a_browser_or_by_one_that_prints_nothing_a_book_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CHROMIUM", "no-such-browser")
    assert main(["--pdf", str(tmp_path / "book.pdf"), "--only", "1"]) == 2
    assert capsys.readouterr().err.startswith("a PDF needs Chromium or Chrome: install it")
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setenv("CHROMIUM", "false")
    with pytest.raises(command.BrowserError, match="false printed nothing"):
        command._printed("<p>")


def test_all_forms_stand_beside_the_pages_and_the_contents_leads_to_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "chromium", lambda: None)
    assert main([str(tmp_path), "--all", "--only", "1"]) == 0
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    links = re.findall(r'href="([^"]+)">(?:notebooks|slides|PDF)<', page)
    # the lecture shows pictures of chapters that are not among these
    assert links == ["notebooks/index.html"]
    near = re.findall(r'href="(notebooks/chapter[^"]+)"', (tmp_path / f"{CHAPTERS[1].stem}.html").read_text("utf-8"))
    links += near
    assert len(near) == 1
    for link in links:
        assert (tmp_path / link).is_file()
    listed = (tmp_path / "notebooks" / "index.html").read_text(encoding="utf-8")
    for link in re.findall(r'href="([^"]+)"', listed):
        assert (tmp_path / "notebooks" / link).is_file()


@pytest.mark.parametrize(
    ("words", "told"), [([], "name the folder that the pages go to"), (["--all"], "--all needs the folder")]
)
def test_a_command_that_says_nothing_is_told_what_it_may_say(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert told in capsys.readouterr().err


runs = pytest.mark.skipif(bool(MISSING), reason=f"{', '.join(MISSING)} not installed")


def _pictures(outputs: list[dict[str, Any]]) -> int:
    return sum("image/png" in output.get("data", {}) for output in outputs)


def test_a_notebook_folds_the_functions_that_the_course_asks_for() -> None:
    for path in CHAPTERS:
        chapter = read_chapter(path)
        told = ["".join(c["source"]) for c in json.loads(notebook(chapter))["cells"] if c["cell_type"] == "markdown"]
        # what is left once the folded parts are taken out
        left = re.sub(r"<details>.*?</details>", "", "\n".join(told), flags=re.DOTALL)
        assert "yours to write first" not in left
        for name in (name for stage in COURSE for name in stage.names):
            assert f"def {name}(" not in left, (path.name, name)


def test_a_notebook_holds_the_chapter_and_folds_what_a_page_folds() -> None:
    written = json.loads(notebook(_small()))
    cells = [(c["cell_type"], c["metadata"].get("jupyter", {}).get("source_hidden", False)) for c in written["cells"]]
    texts = ["".join(c["source"]) for c in written["cells"]]
    prose, folded = ("markdown", False), ("code", True)
    assert cells[2:] == [prose, folded, folded, ("code", False), prose, prose, folded, prose, folded, prose]
    assert "(chapter_02_other.ipynb)" in texts[2]
    assert texts[5] == "x = 2\nx + 1;"
    assert texts[7] == "<details><summary>Answer</summary>\n\nIt is 2.\n\n</details>"
    assert texts[8] == 'two = 2\nprint("two")\nassert two == x'
    assert 'html("stack")' in texts[10]
    assert texts[11] == "And on."
    assert len({c["id"] for c in written["cells"]}) == len(cells)
    assert notebook(_small()) == notebook(_small())


@runs
def test_a_small_notebook_shows_its_picture_caption_widget_and_print_and_nothing_else() -> None:
    # a port that the kernel is to take may be taken before it does
    no_port = 'import ipykernel; assert ipykernel.get_connection_info(unpack=True)["transport"] == "ipc"'
    outputs = [output for cell in executed(notebook(_small()), behind=no_port) for output in cell["outputs"]]
    assert _pictures(outputs) == 1
    data = [output["data"] for output in outputs if "data" in output]
    assert ["text/html" in each for each in data] == [False, False, True]
    assert data[1]["text/markdown"] == "A line with $y$."
    assert [output["text"] for output in outputs if output["output_type"] == "stream"] == ["two\n"]
    assert len(outputs) == 4


def _first_cell(place: Path, path: list[str]) -> subprocess.CompletedProcess[str]:
    """Run a notebook's first cell in a Python that has these folders on its path and nothing installed."""
    cells = [each for each in json.loads(notebook(_small()))["cells"] if each["cell_type"] == "code"]
    code = f"import sys; sys.path += {path!r}\n" + "".join(cells[0]["source"]) + "\nimport pop_ref"
    return subprocess.run([sys.executable, "-ISc", code], cwd=place, capture_output=True, text=True)


def test_the_first_cell_finds_the_clone_that_the_notebook_lies_in(tmp_path: Path) -> None:
    below = tmp_path / "clone" / "out" / "notebooks"
    below.mkdir(parents=True)
    (tmp_path / "clone" / "pop_ref").symlink_to(Path(pop_ref.__file__).parent)
    packages = [str(Path(numpy.__file__).parents[1])]
    done = _first_cell(below, packages)
    assert done.returncode == 0, done.stderr
    # where there is no clone, one line says what to do
    done = _first_cell(tmp_path, packages)
    assert "ImportError: pop_ref missing. Start Jupyter inside the clone of pop-splatting, or" in done.stderr
    done = _first_cell(below, [])
    assert "matplotlib missing. Start Jupyter inside the clone" in done.stderr
    assert f"{sys.executable} -m pip install matplotlib" in done.stderr
    # chapter 0 reads a capture, for which the clone's other package must be installed
    cells = json.loads(notebook(read_chapter(CHAPTERS[0])))["cells"]
    first = "".join(next(each for each in cells if each["cell_type"] == "code")["source"])
    code = f"import sys; sys.path += {[str(tmp_path / 'clone')]!r}\n{first}"
    done = subprocess.run([sys.executable, "-ISc", code], cwd=below, capture_output=True, text=True)
    assert "cv2, matplotlib, numpy, pop_fast missing" in done.stderr
    assert "-m pip install ./pop_ref . matplotlib numpy\n" in done.stderr


# the first nine chapters are read without torch; from the last on, so that two workers seldom wait for one chapter
@runs
@pytest.mark.slow
@pytest.mark.parametrize("path", CHAPTERS[::-1], ids=lambda path: path.stem)
def test_every_picture_of_a_chapter_appears_in_its_notebook(path: Path) -> None:
    chapter, run = read_chapter(path), run_of(path)
    assert run.outputs is not None
    if int(chapter_number(path).rstrip("b")) <= 9:
        assert "pop_ref" in run.modules
        assert "torch" not in run.modules
    outputs = [output for each in run.outputs for output in each]
    drawn = sum(cell.text.count("\npicture(") + cell.text.count("\nfilm(") for cell in chapter.cells)
    assert _pictures(outputs) == drawn > 0
    assert [output for output in outputs if output["output_type"] == "error" or output.get("name") == "stderr"] == []
