"""Every chapter's page in a browser: on a desktop and a phone, light and dark, nothing sticks out or complains."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from pop_ref.walkthrough.builder.chapter import read_chapter
from pop_ref.walkthrough.builder.layout import chapter_page, index_page
from tests.walkthrough.chromium import SCREENSHOTS, WHY_NOT, Page, keep
from tests.walkthrough.ran import CHAPTERS, ran

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT)]

# how a page is opened; it is then looked at with the other preference too
OPENED = [(900, False), (400, True)]
# what is wider than its own box and neither scrolls nor is cut off there
STICKS_OUT = """[...document.querySelectorAll('main *')].filter(each => {
    const box = each.getBoundingClientRect();
    const scrolls = each.closest('pre, .wide, .math.block, svg');
    return box.width && box.right > innerWidth + 1 && !scrolls;
}).map(each => each.tagName + ' ' + each.className + ' ' + each.textContent.slice(0, 60))"""


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    with Page() as opened:
        yield opened


def _looked_at(page: Page, file: Path) -> None:
    for width, dark in OPENED:
        page.open(file, width=width, dark=dark)
        # answers, too, must fit
        page.ask("document.querySelectorAll('details').forEach(each => { each.open = true; })")
        _is_sound(page, file.stem, width, dark)
        page.switch(dark=not dark)
        _is_sound(page, file.stem, width, not dark)


def _is_sound(page: Page, name: str, width: int, dark: bool) -> None:
    page.ask("new Promise(done => setTimeout(() => done(1), 100))")
    assert page.complaints == []
    assert page.ask("document.documentElement.scrollWidth") <= width, page.ask(STICKS_OUT)
    assert page.ask(STICKS_OUT) == []
    paper = page.ask("getComputedStyle(document.body).backgroundColor")
    assert (sum(int(each) for each in paper[4:-1].split(",")) < 300) == dark
    # an ink that would vanish on this paper
    assert page.ask("getComputedStyle(document.body).color") != paper
    # of a whole page it takes seconds
    if SCREENSHOTS or name == "index":
        keep(page.picture("body"), f"{name}_{width}_{'dark' if dark else 'light'}.png")


@pytest.mark.parametrize("path", CHAPTERS, ids=lambda path: path.stem)
def test_a_page_fits_its_window_and_complains_of_nothing(page: Page, path: Path, tmp_path: Path) -> None:
    chapter, outcomes = ran(path)
    file = tmp_path / chapter.page
    file.write_text(chapter_page(chapter, outcomes, [read_chapter(each) for each in CHAPTERS]), encoding="utf-8")
    _looked_at(page, file)
    widgets = page.ask("[...document.querySelectorAll('.pop-widget')].map(each => each.hidden)")
    assert len(widgets) == sum(cell.text.count("{{widget: ") for cell in chapter.cells)
    assert not any(widgets)


def test_a_printed_function_opens_when_its_stage_is_passed_or_at_the_second_click(page: Page, tmp_path: Path) -> None:
    chapter, outcomes = ran(CHAPTERS[2])
    written = chapter_page(chapter, outcomes, [read_chapter(each) for each in CHAPTERS])
    for name in ("first.html", "second.html"):
        (tmp_path / name).write_text(written, encoding="utf-8")
    opened = "[...document.querySelectorAll('details.yours')].map(each => [each.dataset.stage, each.open])"
    page.open(tmp_path / "first.html")
    stages = [stage for stage, _ in page.ask(opened)]
    assert set(stages) == {"activations", "optimizer"}
    assert not any(is_open for _, is_open in page.ask(opened))
    click = "document.querySelector('details.yours summary').click()"
    page.ask(click)
    assert not any(is_open for _, is_open in page.ask(opened))
    assert f"pop learn check {stages[0]}" in page.ask("document.querySelector('details.yours summary').textContent")
    page.ask(click)
    assert [is_open for _, is_open in page.ask(opened)] == [True] + [False] * (len(stages) - 1)
    # the names of passed stages, as `pop learn check` prints them behind an address
    page.open(tmp_path / "second.html", fragment="#passed=tiles,optimizer")
    assert page.ask(opened) == [[stage, stage == "optimizer"] for stage in stages]
    assert set(page.ask("[...document.querySelectorAll('nav a')].map(a => a.hash)")) == {"#passed=tiles,optimizer"}


def test_the_contents_fits_its_window_and_complains_of_nothing(page: Page, tmp_path: Path) -> None:
    file = tmp_path / "index.html"
    beside = {"notebooks": "notebooks", "slides": "slides.html", "PDF": "walkthrough.pdf"}
    file.write_text(index_page([read_chapter(each) for each in CHAPTERS], beside), encoding="utf-8")
    _looked_at(page, file)
