"""How prose, formulas and code are set on a page."""

from __future__ import annotations

import re

import pytest

from pop_ref.walkthrough.builder.chapter import as_wide_as_a_page, chapter_files, read_chapter
from pop_ref.walkthrough.builder.layout import prose

ANY = read_chapter(chapter_files()[0])


def _set(text: str) -> str:
    return prose(ANY, text)


def test_a_signature_is_broken_where_it_is_wider_than_a_page() -> None:
    short = "def f(x: int) -> int:\n    # why (A27)\n    return x"
    assert as_wide_as_a_page(short) == "def f(x: int) -> int:\n    # why\n    return x"
    given = ", ".join(f'{name * 12}: Float64[np.ndarray, "N 3"]' for name in "abc")
    wide = f"def f({given}) -> tuple[int, int]:\n    return 1, 2"
    for each in (wide, wide.replace("f(", "f(\n    ").replace(") ->", "\n) ->")):
        lines = as_wide_as_a_page(each).split("\n")
        assert lines[1] == '    aaaaaaaaaaaa: Float64[np.ndarray, "N 3"],'
        assert lines[4:] == [") -> tuple[int, int]:", "    return 1, 2"]


def test_a_comma_behind_a_formula_stays_with_it() -> None:
    assert re.search(r'<span class="math inline stays"><math [^>]*>.*?</math>\.</span>', _set("Of $x^2$."), re.DOTALL)


def test_names_of_functions_stand_apart_from_what_is_no_parenthesis() -> None:
    def formula(latex: str) -> str:
        return re.sub(r"<mspace[^>]*>", " ", _set(f"${latex}$"))

    assert "<mi>o</mi> <mi>exp</mi><mo" in formula(r"o\exp(x)")
    assert "<mi>ln</mi> <mi>o</mi>" in formula(r"\ln o")
    assert "<mi>diag</mi><mo" in formula(r"\operatorname{diag}(2, 1)")
    assert "<msub><mi>max</mi><mi>i</mi></msub> <mi>x</mi>" in formula(r"\max_i x")
    assert "<msub><mi>T</mi><mrow><mi>max</mi></mrow></msub>" in formula(r"T_{\max}")


@pytest.mark.parametrize(
    ("latex", "wanted"),
    [
        (r"(-y, -x)", '(</mo><mo form="prefix">−</mo><mi>y</mi><mo>,</mo><mo form="prefix">−</mo><mi>x</mi>'),
        (r"a = -b", '<mo>=</mo><mo form="prefix">−</mo>'),
        (r"(a) - b", ")</mo><mo>−</mo>"),
        (r"J^\top", "<mi>⊤</mi>"),
        (r"/ \partial o", "<mo>/</mo><mi>∂</mi>"),
        (r"q/\lvert q\rvert", '/</mo><mo stretchy="false" form="prefix">|</mo><mi>q</mi>'),
        (r"|q| d", '<mi>q</mi><mo stretchy="false" form="postfix">|</mo><mi>d</mi>'),
        (r"a \;|\; b", '<mo stretchy="false">|</mo>'),
    ],
)
def test_signs_and_bars_of_a_formula_stand_at_what_they_belong_to(latex: str, wanted: str) -> None:
    assert wanted in _set(f"${latex}$")


def test_a_long_line_of_code_hangs_and_short_code_stays_on_a_page() -> None:
    long = f"n = [\n    {'1, ' * 30}\n]"
    assert '<span class="hangs" style="--at:8ch">    <span' in _set(f"```python\n{long}\n```")
    assert '<pre class="short"><code><span class="n">n</span>' in _set("```python\nn = 1\n```")
    lines = "n = 1\n" * 13
    assert '<pre><code><span class="n">n</span>' in _set(f"```python\n{lines}```")


@pytest.mark.parametrize(
    ("function", "stage"),
    [
        ("projection.projection_jacobians_vjp", ["projection"]),
        ("projection._offset_vjp", ["projection"]),
        # it alone states the formula
        ("harmonics._basis_one", []),
        ("tiles.listed_pixels", []),
    ],
)
def test_a_function_is_folded_that_the_course_asks_for_or_that_does_its_work(function: str, stage: list[str]) -> None:
    page = _set(f"{{{{source: pop_ref.{function}}}}}")
    assert "<pre" in page
    assert re.findall(r'<details class="yours" data-stage="(\w+)">', page) == stage
