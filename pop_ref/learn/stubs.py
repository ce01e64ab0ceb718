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
_NOT_HERE: Final = dict.fromkeys(("points", "mask", "background", "antialiased"), "not in this course; leave it out.")
_SETTINGS: Final = {
    "grow_masks": {
        "config": "of its fields you need four: `grow_grad2d` (2e-4), the average gradient over which a Gaussian is"
        " chosen; `grow_scale3d` (0.01), the share of the scene's scale up to which it is small; `blur_start_iter` and"
        " `blur_stop_iter` (3000 and 7000), between which, both included, the flags `statistics.blurred` count too."
    },
    "prune_mask": {"config": "of its fields you need one: `prune_opa` (0.005). POP prunes by opacity alone."},
    "composite_pixel_vjp": {
        "totals": "the sums over pixels, added to. `v_means2d_abs` sums the absolute values of what each pixel adds to"
        " `v_means2d`."
    },
    "look": {"recipe": "what is minimised, for `objective`. The course draws harmonics of degree 0.", **_NOT_HERE},
    "train_step": {
        "recipe": "what is minimised: `look` and `update` read it, `accumulate` and `control` take its `density`."
        " `state.step` counts from 0. `waiting` is what `update` gives besides the rows; it goes into the new"
        " `Training`.",
        **_NOT_HERE,
    },
}
# where a docstring's formulas are of other programs, too, or stand in its module's text
_FORMULAS: Final = {
    "in_front": ["near <= z <= far"],
    "prune_mask": ["o < prune_opa"],
    "alpha_from_sigma_vjp": ["v_sigma = -o exp(-sigma) v_alpha", "v_o = exp(-sigma) v_alpha, both 0 over the ceiling"],
    "low_pass": ["Sigma2d + eps2d [[1, 0], [0, 1]]"],
    "projection_jacobians_vjp": [
        "v_x = -(fx/z^2) v_xz and v_z = -(fx/z^2) v_xx + (2 fx x/z^3) v_xz where x/z is not clamped",
        "v_z = -(fx/z^2) v_xx + (fx tx/z^3) v_xz where it is",
        "y likewise",
    ],
    "tile_span": ["first = floor((u - r) / t)", "last = ceil((u + r) / t)", "both in 0 to n_tiles"],
    "tile_lists": ["sort by (depth, index)", "tile (x, y) is number y tiles_x + x"],
    "composite_pixel_vjp": [
        "behind = background . v_color + v_T_final, and from the last splat to the first q = c_i . v_color, v_alpha ="
        " T_i (q - behind), v_c = T_i alpha_i v_color, then behind += alpha_i (q - behind)"
    ],
    "pop_loss": ["mean of 1 - o where the mask is true + mean of o where it is not"],
    "pop_loss_vjp": ["-v_loss / N_imp where the mask is true", "v_loss / (N - N_imp) where it is not"],
    "adam_step": [
        "m = beta1 m + (1 - beta1) g",
        "v = beta2 v + (1 - beta2) g^2",
        "x = x - lr (m / (1 - beta1^t)) / (sqrt(v / (1 - beta2^t)) + eps)",
    ],
    "clone_rows": ["params = rows, then copies of rows[mask]", "m, v = rows, then zeros"],
    "prune_rows": ["params, m, v = rows[~mask]"],
    "grow_masks": ["small = max scale <= grow_scale3d scene_scale"],
}
# what the oracle's loop does for other methods; a stub does not speak of it
_OF_OTHER_METHODS: Final = re.compile(r"opacity_entropy|depth_samples|sparse_depth_loss|tile_rects")
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
    homes = [(module, name) for module, names in stage.functions.items() for name in names]
    return "\n\n".join(without_docstring(_source(module), _functions(module)[name]) for module, name in homes)


def without_docstring(text: str, node: ast.FunctionDef) -> str:
    """Return a function's lines, of its module's text, but for its docstring."""
    lines = text.split("\n")[node.lineno - 1 : node.end_lineno]
    if ast.get_docstring(node) is not None:
        told = node.body[0]
        del lines[told.lineno - node.lineno : (told.end_lineno or told.lineno) - node.lineno + 1]
    return "\n".join(lines)


def formulas(module: str, name: str) -> list[str]:
    """Return the formulas of a function: those that its docstring states, unless the course has its own.

    Example:
        >>> formulas("alpha", "falloff")
        ['G = exp(-sigma)']
    """
    text = (ast.get_docstring(_functions(module)[name]) or "").partition("\nSource:")[0]
    return _FORMULAS.get(name) or _formulas_in(text)


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
    about, example, rest = docstring.partition("\n\nSource:")
    about = "\n\n".join(_filled(paragraph) for paragraph in about.split("\n\n"))
    return "\n".join(_wrapped(line) for line in f"{about}{example}{rest}".split("\n"))


def _filled(paragraph: str) -> str:
    """Break the lines of a paragraph anew, from which labels were taken or in which they are words now."""
    return paragraph if ">>>" in paragraph else textwrap.fill(" ".join(paragraph.split()), _WIDTH)


def _labels_in_words(text: str) -> str:
    # in brackets a label is a reference, which leads nowhere here
    text = re.sub(r"\s\((?:[ABD]\d+(?:, )?)+(?::[^()]*)?\)", "", text)
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
    others = [each if not _formulas_in(each) else _plain_sentences(each) for each in others]
    kept = [first if first.endswith(".") else f"{first}.", *filter(None, others)]
    return "\n\n".join([*kept, f"{source}{rest}"])


def _plain_sentences(paragraph: str) -> str:
    """Keep of a paragraph the sentences that give no formula away: what holds at a limit is asked for."""
    sentences = re.split(r"(?<=\.)\s+(?=[A-Z])", " ".join(paragraph.split()))
    return " ".join(each for each in sentences if "`" not in each)


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
    """Write how a class is made or a function called, what it is for, and what it returns."""
    about = inspect.getdoc(value) or ""
    if inspect.isclass(value):
        paragraphs = about.split("\n\n")
        told = paragraphs[0] if len(paragraphs) == 1 or ":\n" in paragraphs[1] else " ".join(paragraphs[:2])
        made = [f"`{name}`" for name, each in vars(value).items() if isinstance(each, property)]
        told += f" It has {', '.join(made)}, too." if made else ""
    else:
        returned = re.search(r"Returns:\n(.*?)(?:\n\n|\Z)", about, re.DOTALL)
        told = about.split("\n")[0] + (f" Returns: {returned[1].strip()}" if returned else "")
    told = " ".join(_labels_in_words(told).split())
    return textwrap.wrap(f"{called}: {told}", 116, initial_indent="    ", subsequent_indent="        ")


def _imports(stage: Stage, used: set[str]) -> list[str]:
    """Import what the oracle's functions use."""
    own = set(stage.names)
    plain, ours = {"import math", "import numpy as np"}, dict[str, list[str]]()
    for module in stage.functions:
        for node in ast.parse(_source(module)).body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
                origin, names = f"pop_ref.{module}", [node.name]
            elif isinstance(node, ast.ImportFrom) and node.module != "__future__":
                origin, names = str(node.module), [alias.name for alias in node.names]
            else:
                continue
            fresh = [name for name in names if name in used - own and not _OF_OTHER_METHODS.match(name)]
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
