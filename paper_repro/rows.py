"""The rows of the paper's tables and figures: one file of `configs` each, read with errors that name file and field.

A row names a method of `pop train` and the options in which it differs from it, on the whole schedule of the paper;
`paper_repro.jobs` carries them over to other scales. Options that belong to a dataset or a scene alone stand in the
table `[scenes]`, by its key there or by the scene's name.
"""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

from paper_repro.scenes import DATASETS, SCENES, PaperScene
from pop_fast.errors import PopError
from pop_ref.registry import Registry

CONFIGS: Final = Path(__file__).resolve().parent / "configs"
# in the order of the tables; what they hold is in the files
_OWN: Final = (
    *("3dgs", "3dgs_2023", "gsplat", "pup", "pup_star", "mini_splatting", "mini_splatting_star"),
    *("taming", "speedy_splat", "pop"),
    *("l2", "l2_blur", "l2_pop", "reset", "blur_3k_4k", "blur_3k_11k", "blur_3k_15k"),
    *("l2_without_ssim", *(f"l1_div_{n}" for n in (1, 2, 5, 10, 20, 50, 100))),
    *("final_prune", "opacity_entropy"),
    *("pop_visible", "pop_any_view", "l2_blur_any_view", "pop_sum", "pop_size_prune", "pop_prune_002"),
)
# another package adds a row as the path of its file, under the entry point group or with `ROWS.register`
ROWS: Final[Registry[Path]] = Registry(
    "row", "pop_splatting.rows", {name: CONFIGS / f"{name}.toml" for name in _OWN}, needs=("read_text",), error=PopError
)
# floats of one Gaussian in the files whose size the tables give: gsplat's checkpoint, and Inria's PLY with its normals
_BYTES: Final = (236, 248)


@dataclass(frozen=True, kw_only=True)
class Row:
    """What a row of a table is trained with.

    Attributes:
        name: of the row, and of its file.
        title: what it is, in a few words.
        method: its name for `pop train --method`.
        options: the options of `pop train` in which it differs from that, on the whole schedule.
        tables: the paper's tables that it stands in.
        figures: the paper's figures that it stands in.
        paper: its name in the paper's tables, by table; empty beyond the paper.
        description: about ten lines: what the method does, from which sources, and what is left out.
        cost: time of a training over that of POP, for the order of a queue; from the paper's table where it has one.
        bytes_per_gaussian: of the file whose size the paper's table gives.
        scenes: further options by dataset or scene; the scene's own come last.
        base: the row from whose training it begins, where that is finished, or None; see `paper_repro.base`.
    """

    name: str
    title: str
    method: str
    options: tuple[str, ...]
    tables: tuple[int, ...]
    figures: tuple[str, ...]
    paper: Mapping[str, str]
    description: str
    cost: float
    bytes_per_gaussian: int
    scenes: Mapping[str, tuple[str, ...]]
    base: str | None = None

    def options_for(self, scene: PaperScene) -> tuple[str, ...]:
        """Return its options on a scene: its own, the dataset's, the scene's."""
        return (*self.options, *self.scenes.get(scene.dataset, ()), *self.scenes.get(scene.name, ()))


def load_row(name: str, folder: Path = CONFIGS) -> Row:
    """Read a row's file.

    Raises:
        PopError: there is no such row, or its file is not TOML, or a field is absent, unknown or of the wrong type.
    """
    path = _file_of(name, folder)
    if not path.is_file():
        raise PopError(f"row is '{name}'; it must be one of {', '.join(ROWS)}")
    try:
        found = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise PopError(f"{path}: is not TOML: {error}") from error
    wanted = [field.name for field in fields(Row) if field.name != "name"]
    for field in [*wanted, *found]:
        if field not in wanted:
            raise PopError(f"{path}: {field} is not a field of a row; the fields are {', '.join(wanted)}")
        if field not in found and field not in ("scenes", "base"):
            raise PopError(f"{path}: has no {field}")
    return _checked(name, path, {"scenes": {}, **found})


def added_rows() -> list[Row]:
    """Read the rows of other packages."""
    return [load_row(name) for name in ROWS if name not in _OWN]


def _file_of(name: str, folder: Path) -> Path:
    return ROWS[name] if name not in _OWN and name in ROWS else folder / f"{name}.toml"


def load_rows(folder: Path = CONFIGS) -> list[Row]:
    """Read every row, in the order of the tables."""
    return [load_row(name, folder) for name in ROWS]


def header_of(name: str, folder: Path = CONFIGS) -> dict[str, str]:
    """Read what a row's file opens with: its claim, the hardware and the hours.

    Raises:
        PopError: one of the three is absent.
    """
    path = _file_of(name, folder)
    found: dict[str, str] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        key, _, text = line.removeprefix("#").strip().partition(": ")
        found[key.lower()] = text.strip()
    for key in ("claim", "hardware", "hours"):
        if not found.get(key):
            raise PopError(f"{path}: its first lines must be '# Claim: ...', '# Hardware: ...' and '# Hours: ...'")
    return found


def _checked(name: str, path: Path, found: Mapping[str, Any]) -> Row:
    def fail(field: str, must: str) -> PopError:
        return PopError(f"{path}: {field} is {found[field]!r}; it must be {must}")

    for field in ("title", "method", "description"):
        if not isinstance(found[field], str) or not found[field].strip():
            raise fail(field, "a text")
    for field in ("options", "figures"):
        if not _is_texts(found[field]):
            raise fail(field, "a list of texts")
    if not isinstance(found["tables"], list) or not all(type(number) is int for number in found["tables"]):
        raise fail("tables", "a list of whole numbers")
    for field, inner in (("paper", lambda value: isinstance(value, str)), ("scenes", _is_texts)):
        if not isinstance(found[field], dict) or not all(map(inner, found[field].values())):
            raise fail(field, "a table of texts" if field == "paper" else "a table of lists of texts")
    if found.get("base") is not None and found["base"] not in ROWS:
        raise fail("base", f"one of {', '.join(ROWS)}")
    strange = next((key for key in found["scenes"] if key not in (*DATASETS, *SCENES)), None)
    if strange is not None:
        raise PopError(f"{path}: scenes.{strange} is neither a dataset nor a scene")
    cost, size = found["cost"], found["bytes_per_gaussian"]
    if not isinstance(cost, int | float) or isinstance(cost, bool) or not 0.0 < cost <= sys.float_info.max:
        raise fail("cost", "a number above 0")
    if size not in _BYTES:
        raise fail("bytes_per_gaussian", " or ".join(map(str, _BYTES)))
    return Row(
        name=name,
        title=found["title"],
        method=found["method"],
        options=tuple(found["options"]),
        tables=tuple(found["tables"]),
        figures=tuple(found["figures"]),
        paper=dict(found["paper"]),
        description=found["description"].strip(),
        cost=float(cost),
        bytes_per_gaussian=size,
        scenes={key: tuple(value) for key, value in found["scenes"].items()},
        base=found.get("base"),
    )


def _is_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)
