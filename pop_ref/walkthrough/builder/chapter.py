"""Read a chapter, a script in percent format: its cells, what a directive in its prose stands for, what code is for.

A line `{{name: argument}}` of prose stands for code or a table made from the package itself: `{{source:
pop_ref.alpha.falloff}}` for a function as its file has it, without its docstring, `{{bug: name}}` for the function with
one of the kit's mutants in it, `{{glossary}}`, `{{stages}}` and `{{chapters}}` for tables. All but `{{widget: name}}`,
which only a page can show, are expanded to markdown, so that pages, notebooks and slides have the same.
"""

from __future__ import annotations

import ast
import importlib.util
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, NamedTuple

from pop_ref.learn.course import COURSE
from pop_ref.learn.stubs import formulas, without_docstring

Kind = Literal["prose", "code", "setup", "answer"]
Role = Literal["plain", "imports", "checks", "draws"]

CHAPTERS: Final = Path(__file__).resolve().parents[1]
# in the order of a chapter: guess, then prove, then program, then read what is wrong
TIERS: Final = ("predict", "derive", "code", "find the bug")
# how wide a page is, in characters of code
PAGE: Final = 96

_KINDS: Final[dict[str, Kind]] = {"": "code", "[markdown]": "prose", "setup": "setup", "answer": "answer"}
_NAME: Final = re.compile(r"^chapter_(\d\d)([a-z]?)_[a-z0-9_]+$")
_TITLE: Final = re.compile(r"^# (\d+[a-z]?)\. (.+)$")
_MINUTES: Final = re.compile(r"^# minutes: (\d+)$", re.MULTILINE)
_EXERCISE: Final = re.compile(r"^### Exercise (\d+): (\w[\w ]*)$", re.MULTILINE)
_DIRECTIVE: Final = re.compile(r"^\{\{(\w+)(?:: ([^}]+))?\}\}$", re.MULTILINE)
# what the oracle's files call an ambiguity of the papers
_AMBIGUITY: Final = re.compile(r"(?m)^( *#.*?) \(A\d+\)")


class ChapterError(Exception):
    """A chapter cannot be read, run or laid out; the message begins with its file and line."""

    def __init__(self, path: Path, line: int, what: str) -> None:
        super().__init__(f"{path.name}:{line}: {what}")


@dataclass(frozen=True)
class Cell:
    """One cell: prose without its comment marks, or code as it stands; `line` is where `text` begins in the file."""

    kind: Kind
    text: str
    line: int


@dataclass(frozen=True)
class Chapter:
    """A chapter: its number ("4b") and title from the first heading, the paragraph under it, and all cells in order.

    Attributes:
        minutes: that a reader needs, exercises included.
    """

    path: Path
    number: str
    title: str
    minutes: int
    opening: str
    cells: tuple[Cell, ...]

    @property
    def page(self) -> str:
        """Name the file of the chapter's page."""
        return f"{self.path.stem}.html"

    @property
    def module(self) -> str:
        """Name the module that the chapter is."""
        return f"pop_ref.walkthrough.{self.path.stem}"

    @property
    def tiers(self) -> list[str]:
        """List what kind each exercise is of, in order; each has an answer."""
        return [tier for cell in self.cells if cell.kind == "prose" for _, tier in _EXERCISE.findall(cell.text)]

    def code_after(self, cell: Cell) -> list[str]:
        """List the code of all later cells."""
        return [each.text for each in self.cells if each.kind != "prose" and each.line > cell.line]


class Part(NamedTuple):
    """A run of whole statements of a cell, and what they are there for."""

    text: str
    role: Role


def chapter_files(folder: Path = CHAPTERS) -> list[Path]:
    """List the chapters' files in the order in which they are read."""
    return sorted(folder.glob("chapter_*.py"))


def chapter_number(path: Path) -> str:
    """Read a chapter's number off its file's name: "4", or "4b" for what stands between 4 and 5.

    Raises:
        ChapterError: the name is not `chapter_NN_short_name.py`.
    """
    named = _NAME.match(path.stem)
    if named is None:
        raise ChapterError(path, 1, "a chapter's file is named chapter_NN_short_name.py")
    return f"{int(named[1])}{named[2]}"


def read_chapter(path: Path, text: str | None = None) -> Chapter:
    """Read one chapter and hold it to the form that all chapters have.

    Args:
        path: the file, named `chapter_NN_short_name.py`.
        text: what the file says, default read from it.

    Raises:
        ChapterError: a cell, the title or an exercise does not have its form.
    """
    text = path.read_text(encoding="utf-8") if text is None else text
    cells = tuple(_cells(path, text))
    number = chapter_number(path)
    if not cells or cells[0].kind != "prose":
        raise ChapterError(path, 1, "the first cell must be prose, '# %% [markdown]'")
    heading, _, rest = cells[0].text.partition("\n")
    titled = _TITLE.match(heading)
    if titled is None or titled[1] != number:
        told = f"the first line must be '# # {number}. Title', it is {'# ' + heading!r}"
        raise ChapterError(path, cells[0].line, told)
    opening = rest.strip().split("\n\n")[0]
    if not opening or opening.startswith("#"):
        raise ChapterError(path, cells[0].line, "a paragraph on what the chapter teaches must follow the title")
    _check_exercises(path, cells)
    minutes = _MINUTES.search(text)
    if minutes is None:
        raise ChapterError(path, 1, "a line '# minutes: 20' must tell how long the chapter takes")
    return Chapter(path, number, titled[2], int(minutes[1]), opening, cells)


def _cells(path: Path, text: str) -> list[Cell]:
    cells: list[Cell] = []
    lines = text.splitlines()
    starts = [i for i, line in enumerate(lines) if line.startswith("# %%")]
    for start, end in zip(starts, [*starts[1:], len(lines)], strict=True):
        word = lines[start].removeprefix("# %%").strip()
        if word not in _KINDS:
            told = f"a cell is marked '# %%', '# %% [markdown]', '# %% setup' or '# %% answer', not {word!r}"
            raise ChapterError(path, start + 1, told)
        filled = [i for i in range(start + 1, end) if lines[i].strip()]
        if not filled:
            raise ChapterError(path, start + 1, "the cell is empty")
        body = lines[filled[0] : filled[-1] + 1]
        if word == "[markdown]":
            for number, line in enumerate(body, start=filled[0] + 1):
                if line != "#" and not line.startswith("# "):
                    raise ChapterError(path, number, f"a line of prose begins with '# ', this one is {line!r}")
            body = [line[2:] for line in body]
        cells.append(Cell(_KINDS[word], "\n".join(body), filled[0] + 1))
    return cells


def _check_exercises(path: Path, cells: tuple[Cell, ...]) -> None:
    asked, before = 0, cells[0]
    for cell in [*cells[1:], Cell("prose", "", cells[-1].line)]:
        exercise = _EXERCISE.match(before.text) if before.kind == "prose" else None
        if exercise is not None:
            asked += 1
            if int(exercise[1]) != asked:
                raise ChapterError(path, before.line, f"this is exercise {asked}, not {exercise[1]}")
            if exercise[2] not in TIERS:
                told = f"exercise {asked} is one of {', '.join(TIERS)}, not {exercise[2]!r}"
                raise ChapterError(path, before.line, told)
            if cell.kind != "answer":
                told = f"exercise {asked} has no answer: a cell '# %% answer' must follow"
                raise ChapterError(path, before.line, told)
            if not any(map(_asserts, ast.walk(_parsed(path, cell)))):
                raise ChapterError(path, cell.line, f"the answer to exercise {asked} asserts nothing")
        elif cell.kind == "answer":
            told = "an answer must follow its exercise, a prose cell '# ### Exercise k: predict'"
            raise ChapterError(path, cell.line, told)
        before = cell


def _asserts(node: ast.AST) -> bool:
    # `caught` asserts that a law of the kit notices a mistake
    return isinstance(node, ast.Assert) or (isinstance(node, ast.Call) and ast.unparse(node.func) == "caught")


def _parsed(path: Path, cell: Cell) -> ast.Module:
    try:
        return ast.parse(cell.text)
    except SyntaxError as error:
        raise ChapterError(path, cell.line + (error.lineno or 1) - 1, f"SyntaxError: {error.msg}") from error


# Directives.


def expanded(text: str, marked: bool = False) -> str:
    """Expand the directives of a prose cell to markdown; widgets stay.

    Args:
        text: of the cell.
        marked: say of a function that the course asks for in which stage it is, for a page that folds it.

    Raises:
        ValueError: a directive, or what it names, is not known.
    """
    return _DIRECTIVE.sub(lambda found: _expanded(found[1], found[2] or "", found[0], marked), text)


def _expanded(name: str, argument: str, whole: str, marked: bool) -> str:
    from pop_ref.walkthrough.builder import glossary

    if name == "widget":
        return whole
    if name in ("source", "bug"):
        code, file = source_of(argument) if name == "source" else broken_function(argument)
        written = argument if name == "source" else code.partition("def ")[2].partition("(")[0]
        stage = _stage_of(written) if marked else ""
        # a page folds what is marked so (`layout`)
        yours = f", yours to write first in `pop learn check {stage}`" if stage else ""
        return f"`{file}`{yours}:\n\n```python\n{as_wide_as_a_page(code)}\n```"
    tables = {"glossary": glossary.glossary, "stages": glossary.stages, "chapters": _chapters}
    if name not in tables:
        raise ValueError(f"{whole} is not a directive")
    return tables[name]()


def _stage_of(path: str) -> str:
    """Name the stage of `pop learn` in which a reader writes this function, or what a private one does for another.

    The course has a formula to show for most functions; where it has none, a page shows what a private one does.
    """
    name = path.rpartition(".")[2]
    for stage in COURSE:
        for home, names in stage.functions.items():
            helped = [each for each in names if formulas(home, each)] if name.startswith("_") else []
            calls = any(f"{name}(" in source_of(f"pop_ref.{home}.{each}")[0] for each in helped)
            if calls or name in names:
                return stage.name
    return ""


def _chapters() -> str:
    rows = []
    for path in chapter_files():
        text = path.read_text(encoding="utf-8")
        title, minutes = re.search(r"^# # (.+)$", text, re.MULTILINE), _MINUTES.search(text)
        if title is not None and minutes is not None:
            rows.append(f"| [{title[1]}]({path.name}) | {minutes[1]} |")
    return "\n".join(["| chapter | minutes |\n|---|---|", *rows])


def source_of(path: str) -> tuple[str, str]:
    """Return a function's code without its docstring, and the file that it is in.

    Args:
        path: module and function, as `pop_ref.alpha.falloff`.

    Raises:
        ValueError: there is none such.
    """
    module, _, name = path.rpartition(".")
    spec = importlib.util.find_spec(module) if module else None
    if spec is None or spec.origin is None:
        raise ValueError(f"{path}: there is no such module")
    text = Path(spec.origin).read_text(encoding="utf-8")
    for node in ast.parse(text).body:
        if isinstance(node, ast.FunctionDef) and node.name == name:
            return without_docstring(text, node), f"{module.replace('.', '/')}.py"
    raise ValueError(f"{path}: there is no such function")


def broken_function(name: str) -> tuple[str, str]:
    """Return the function that a mutant of the kit breaks, broken, without its docstring; and its file.

    Raises:
        ValueError: there is no such mutant, or it breaks no function.
    """
    from pop_ref.walkthrough.bugs import bug_named

    mutant = bug_named(name)
    sound, broken = (CHAPTERS.parent / mutant.file).read_text(encoding="utf-8"), mutant.broken_source()
    pairs = zip(ast.parse(sound).body, ast.parse(broken).body, strict=True)
    for before, after in pairs:
        if isinstance(before, ast.FunctionDef) and isinstance(after, ast.FunctionDef):
            new = without_docstring(broken, after)
            if new != without_docstring(sound, before):
                return new, f"pop_ref/{mutant.file}, with one mistake"
    raise ValueError(f"mutant {name!r} breaks no function")


def as_wide_as_a_page(code: str) -> str:
    """Break a function's signature into a line an argument where a line of it is wider than a page.

    Example:
        >>> as_wide_as_a_page("def f(x: int) -> int:\\n    return x")
        'def f(x: int) -> int:\\n    return x'
    """
    code = _AMBIGUITY.sub(r"\1", code)
    node, lines = ast.parse(code).body[0], code.split("\n")
    assert isinstance(node, ast.FunctionDef)
    n_head = next(i for i, line in enumerate(lines, start=1) if line.endswith(":"))
    if max(map(len, lines[:n_head])) <= PAGE:
        return code
    arguments = [ast.unparse(each) for each in node.args.args]
    for at, default in enumerate(reversed(node.args.defaults), start=1):
        arguments[-at] += f" = {ast.unparse(default)}"
    head = [f"def {node.name}(", *(f"    {each}," for each in arguments)]
    returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    return "\n".join([*head, f"){returns}:"]).replace("'", '"') + "\n" + "\n".join(lines[n_head:])


# What statements are for.


def parts(code: str, used_later: Collection[str] | None = None) -> list[Part]:
    """Cut a cell by what its statements are there for, so that a page shows the code that a reader is here for.

    Drawing begins with the statement that makes axes and ends with the one that calls `picture` or `film`; a function
    that makes axes, or takes them as `ax`, is drawing by itself. Outside of drawing, imports are imports, and an
    assertion, or a loop that does nothing but assert, is a check, and so is an assignment of what only checks look at.
    Comments right above a statement belong to it.

    Args:
        code: a cell that Python can parse.
        used_later: names that later cells look at, by default any.

    Returns:
        The parts in order; together they are the code, but for blank lines between them.
    """
    lines, body = code.split("\n"), ast.parse(code).body
    roles = _roles(body)
    if used_later is not None:
        _fold_what_only_checks_need(body, roles, set(used_later))
    cut: list[tuple[int, Role]] = []
    for node, role in zip(body, roles, strict=True):
        first = min([node.lineno, *(each.lineno for each in getattr(node, "decorator_list", []))]) - 1
        while first > 0 and lines[first - 1].startswith("#"):
            first -= 1
        if not cut or cut[-1][1] != role:
            cut.append((first, role))
    ends = [first for first, _ in cut[1:]] + [len(lines)]
    found = [Part("\n".join(lines[first:end]).strip("\n"), role) for (first, role), end in zip(cut, ends, strict=True)]
    return found or [Part(code, "plain")]


def names_in(codes: Sequence[str]) -> set[str]:
    """Collect the names that cells look at."""
    return set().union(*(_looked_at(ast.parse(code)) for code in codes))


def said_and_done(code: str) -> tuple[str, str]:
    """Part the comment that opens an answer, without its marks, from the code that proves it."""
    lines = code.split("\n")
    n_said = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    said = "\n".join(line.removeprefix("#").removeprefix(" ") for line in lines[:n_said])
    return said, "\n".join(lines[n_said:]).strip("\n")


def _roles(body: list[ast.stmt]) -> list[Role]:
    opens, closes = {"axes", "subplots", "figure"}, {"picture", "film"}
    roles: list[Role] = []
    drawing = False
    for node in body:
        called = {ast.unparse(each.func).rpartition(".")[2] for each in ast.walk(node) if isinstance(each, ast.Call)}
        if isinstance(node, ast.FunctionDef) and not drawing:
            draws = called & opens or any(each.arg == "ax" for each in node.args.args)
            roles.append("draws" if draws else "plain")
            continue
        drawing = drawing or bool(called & (opens | closes))
        imports = isinstance(node, ast.Import | ast.ImportFrom)
        roles.append("draws" if drawing else "imports" if imports else "checks" if _only_asserts(node) else "plain")
        drawing = drawing and not called & closes
    return roles


def _only_asserts(node: ast.stmt) -> bool:
    if isinstance(node, ast.For):
        # names that a loop binds on the way to its assertion are of use to nothing else
        return _only_asserts(node.body[-1]) and all(_only_asserts(n) or isinstance(n, ast.Assign) for n in node.body)
    called = node.value.func if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call) else None
    return isinstance(node, ast.Assert) or (isinstance(called, ast.Attribute) and called.attr.startswith("assert_"))


def _fold_what_only_checks_need(body: list[ast.stmt], roles: list[Role], needed: set[str]) -> None:
    checked = set[str]()
    for i in reversed(range(len(body))):
        node = body[i]
        places = [each for t in node.targets for each in ast.walk(t)] if isinstance(node, ast.Assign) else []
        # what also changes something stays in sight
        changes = any(isinstance(each, ast.Subscript | ast.Attribute) for each in places)
        bound = set() if changes else {each.id for each in places if isinstance(each, ast.Name)}
        if roles[i] == "plain" and bound & checked and not bound & needed:
            roles[i] = "checks"
        (checked if roles[i] == "checks" else needed).update(_looked_at(node))


def _looked_at(node: ast.AST) -> set[str]:
    return {each.id for each in ast.walk(node) if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Load)}
