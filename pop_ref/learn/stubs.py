"""The files that a course begins with: the oracle's functions without their bodies and without their formulas."""

from __future__ import annotations

import ast
import functools
import importlib
import inspect
import re
import textwrap
from pathlib import Path
from typing import Any, Final

import pop_ref
from pop_ref.constants import DECISIONS, KINKS
from pop_ref.learn.course import COURSE, Stage

_ORACLE: Final = Path(pop_ref.__file__).parent
_ABOUT: Final = """
{chapters} Every docstring has an example to try, and those are tried first. What you call from another stage is your
own function where you have written it, and the oracle's where you have not. The course has one profile, `paper`, with
the constants that the chapters print: you may leave the parameter `profile` out, and all that a docstring says of other
programs.
"""
# of a docstring's lines, before it is indented
_WIDTH: Final = 114
# of a class or a function, to be told
_MOST_FIELDS: Final = 12
_LABELS: Final = {label: f"the {words.partition(':')[0]}" for label, words in (DECISIONS | KINKS).items()}
# what the functions of the course read of their settings
_SETTINGS: Final = {
    "grow_masks": {
        "config": "of its fields you need four: `grow_grad2d` (2e-4), the average gradient over which a Gaussian is"
        " chosen; `grow_scale3d` (0.01), the share of the scene's scale up to which it is small; `blur_start_iter` and"
        " `blur_stop_iter` (3000 and 7000), between which, both included, the flags `statistics.blurred` count too."
    },
    "prune_mask": {"config": "of its fields you need one: `prune_opa` (0.005). POP prunes by opacity alone."},
    "train_step": {
        "recipe": "what is minimised: `objective` reads it, `learning_rates` takes its `max_steps` and `lr`,"
        " `accumulate` and `control` take its `density`. Adam's first step is number 1, `state.step` counts from 0. The"
        " course draws harmonics of degree 0; `waiting` belongs to another method.",
        "points": "not in this course; leave it out.",
    },
}
# what the oracle's loop does for other methods; a stub does not speak of it
_OF_OTHER_METHODS: Final = re.compile(r"opacity_entropy|depth_samples|sparse_depth_loss")
_QUOTED: Final = re.compile(r"`([^`]*)`")
_HEAD: Final = '''"""Stage {number} of {count}, {name}: {does}.

{about}

    pop-learn check {name}
"""
'''


def start(folder: Path) -> list[Path]:
    """Write the stubs that are not there yet; a file that is there is left alone.

    Returns:
        The files written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for stage in COURSE:
        path = folder / stage.file
        if not path.exists():
            path.write_text(stub(stage), encoding="utf-8")
            written.append(path)
    return written


def stub(stage: Stage) -> str:
    """Write a stage's stub.

    Example:
        >>> from pop_ref.learn.course import stage_named
        >>> print(stub(stage_named("alpha")).splitlines()[0])
        \"\"\"Stage 8 of 13, alpha: one splat at one pixel.
    """
    number = COURSE.index(stage) + 1
    about = textwrap.fill(" ".join(_ABOUT.format(chapters=_chapters_told(stage)).split()), 120)
    head = _HEAD.format(number=number, count=len(COURSE), name=stage.name, does=stage.does, about=about)
    functions = [_without_body(module, name) for module, names in stage.functions.items() for name in names]
    imported = _imports(stage, set(re.findall(r"\w+", "".join([*functions, answer(stage)]))))
    about = _at_hand(imported)
    head = head.replace("\n    pop-learn", f"{about}\n    pop-learn") if about else head
    return "\n\n".join(["\n".join([head, *imported]), *functions]) + "\n"


def answer(stage: Stage) -> str:
    """Return the oracle's functions of a stage, without their docstrings."""
    parts = []
    for module, names in stage.functions.items():
        lines = _source(module).splitlines()
        for name in names:
            node = _functions(module)[name]
            text = [
                *lines[node.lineno - 1 : node.body[0].lineno - 1],
                *lines[node.body[1].lineno - 1 : node.end_lineno],
            ]
            parts.append("\n".join(text))
    return "\n\n".join(parts)


def formulas(module: str, name: str) -> list[str]:
    """Return the formulas that a function's docstring states.

    Example:
        >>> formulas("alpha", "falloff")
        ['G = exp(-sigma)']
    """
    text = (ast.get_docstring(_functions(module)[name]) or "").partition("\nSource:")[0]
    return _formulas_in(text)


@functools.cache
def _source(module: str) -> str:
    return (_ORACLE / f"{module}.py").read_text(encoding="utf-8")


@functools.cache
def _functions(module: str) -> dict[str, ast.FunctionDef]:
    return {node.name: node for node in ast.parse(_source(module)).body if isinstance(node, ast.FunctionDef)}


def _without_body(module: str, name: str) -> str:
    node = _functions(module)[name]
    signature = "\n".join(_source(module).splitlines()[node.lineno - 1 : node.body[0].lineno - 1])
    told = _of_the_course(name, _without_formulas(ast.get_docstring(node) or ""))
    docstring = textwrap.indent(f'"""{told}\n"""', "    ")
    # blank lines carry no indentation
    docstring = re.sub(r"^ +$", "", docstring, flags=re.MULTILINE)
    return f'\n{signature}\n{docstring}\n    raise NotImplementedError("{name} is yours to write")'


def _chapters_told(stage: Stage) -> str:
    """Say which chapters explain a stage's functions."""
    names: dict[str, list[str]] = {}
    for name in stage.names:
        names.setdefault(stage.chapter_of(name), []).append(name)
    if len(names) == 1:
        return f"Chapter {stage.chapter} of the walk-through explains it."
    others = [f"chapter {chapter} {', '.join(each)}" for chapter, each in names.items() if chapter != stage.chapter]
    return f"Chapter {stage.chapter} of the walk-through explains it, and of its functions {'; '.join(others)}."


def _of_the_course(name: str, docstring: str) -> str:
    """Write labels in words, and explain of the settings what the course has."""
    docstring = _labels_in_words(docstring)
    docstring = re.sub(r' Under "split".*?and split\.', "", docstring, flags=re.DOTALL)
    chapter = next(stage.chapter_of(name) for stage in COURSE if name in stage.names)
    docstring = re.sub(r"see the module's text", f"see chapter {chapter}", docstring)
    docstring = docstring.replace("See the module's text", f"See chapter {chapter}")
    docstring = docstring.replace("gsplat's option of that name.", "not in this course; leave it out, or False.")
    for setting, about in _SETTINGS.get(name, {}).items():
        docstring = re.sub(f"    {setting}: .*", f"    {setting}: {about}", docstring)
    return "\n".join(_wrapped(line) for line in docstring.split("\n"))


def _labels_in_words(text: str) -> str:
    text = re.sub(r" \((?:A\d+(?:, )?)+(?::[^()]*)?\)", "", text)
    return re.sub(r"\b[DB]\d\b", lambda label: _LABELS[label[0]], text)


def _wrapped(line: str) -> str:
    """Break a line of a docstring that its labels in words have made too long."""
    if len(line) <= _WIDTH or ">>>" in line:
        return line
    indent = " " * (len(line) - len(line.lstrip()))
    # what follows a name and a colon is indented below it
    hanging = "    " if re.match(r"\s*\w+: ", line) else ""
    return textwrap.fill(line.strip(), _WIDTH, initial_indent=indent, subsequent_indent=indent + hanging)


def _without_formulas(docstring: str) -> str:
    about, source, rest = docstring.partition("Source:")
    first, *others = about.strip().split("\n\n")
    first = first.partition("`")[0].rstrip(" :,") if _formulas_in(first) else first
    kept = [first if first.endswith(".") else f"{first}.", *(p for p in others if not _formulas_in(p))]
    return "\n\n".join([*kept, f"{source}{rest}"])


def _formulas_in(text: str) -> list[str]:
    return [" ".join(quoted.split()) for quoted in _QUOTED.findall(text) if re.search("[=<>]", quoted)]


def _at_hand(imported: list[str]) -> str:
    """Tell of the imported classes and functions that no student writes what they are called with and what they do."""
    asked = {name for stage in COURSE for name in stage.names}
    lines = []
    for node in ast.parse("\n".join(imported)).body:
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("pop_ref."):
            module = importlib.import_module(str(node.module))
            for alias in node.names:
                value = getattr(module, alias.name)
                if alias.name not in asked and (inspect.isfunction(value) or inspect.isclass(value)):
                    parameters = list(inspect.signature(value).parameters)
                    # a table of settings is told of where a function takes it
                    if len(parameters) <= _MOST_FIELDS and node.module != "pop_ref._shapes":
                        lines += _told_of(f"{alias.name}({', '.join(parameters)})", value)
    return "\n".join(["\nWritten for you:", "", *lines, ""]) if lines else ""


def _told_of(called: str, value: Any) -> list[str]:
    """Write how a class is made or a function called, and the first line of its docstring."""
    first = _labels_in_words((value.__doc__ or "").strip().split("\n")[0])
    return textwrap.wrap(f"{called}: {first}", 116, initial_indent="    ", subsequent_indent="        ")


def _imports(stage: Stage, used: set[str]) -> list[str]:
    """Import what the oracle's functions use of their module: types, and what other stages ask for, in any case."""
    own, asked = set(stage.names), {name for each in COURSE for name in each.names}
    plain, ours = {"import math", "import numpy as np"}, dict[str, list[str]]()
    for module in stage.functions:
        for node in ast.parse(_source(module)).body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
                origin, names = f"pop_ref.{module}", [node.name]
            elif isinstance(node, ast.ImportFrom) and node.module != "__future__":
                origin, names = str(node.module), [alias.name for alias in node.names]
            else:
                continue
            # a type is needed where a result is made of it
            fresh = [name for name in names if name in used | asked or re.match("[A-Z]+[a-z]", name)]
            fresh = [name for name in fresh if name not in own and not _OF_OTHER_METHODS.match(name)]
            if fresh:
                ours.setdefault(origin, []).extend(fresh)
    lines, seen = list[str](), set[str]()
    for origin, names in sorted(ours.items()):
        fresh = [name for name in dict.fromkeys(names) if name not in seen]
        seen.update(fresh)
        line = f"from {origin} import {', '.join(fresh)}"
        long = f"from {origin} import (\n    " + ",\n    ".join(fresh) + ",\n)"
        if fresh:
            lines.append(line if len(line) <= 120 else long)
    standard = [line for line in lines if not line.startswith("from pop_ref")]
    return [
        "from __future__ import annotations\n",
        *sorted({*plain, *standard}),
        "",
        *(x for x in lines if x not in standard),
    ]
