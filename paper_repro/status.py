"""What is reproduced so far: the status table of README.md and docs/paper.md, claims.md, and what protocol.md says.

python -m paper_repro.status            print the status table
python -m paper_repro.status --write    write all of them, from the results that are there
python -m paper_repro.status --check    exit with 1 when a file holds something else
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from paper_repro import claims_page
from paper_repro.claims import claims
from paper_repro.claims_page import deciding, method, outcome, telling
from paper_repro.claims_page import markdown as claims_markdown
from paper_repro.evidence import DATASETS, JUDGE, Claim
from paper_repro.paper import paper
from paper_repro.results import RESULTS, SCALES, Result, read_all
from paper_repro.table_formats import grid
from paper_repro.tables import SCENES_OF, beyond_rows
from pop_fast.errors import PopError
from pop_ref.ambiguities import AMBIGUITIES

HERE: Final = Path(__file__).resolve().parent
_MADE: Final = "<!-- made by python -m paper_repro.status --write -->"
_WRITE: Final = "run 'python -m paper_repro.status --write'"


def status_table(results: Iterable[Result]) -> str:
    """Make the status table: every claim by all scales that decide it, every table by the cells that are run."""
    found = list(results)
    rows = [_claim_row(by_scale, found) for by_scale in zip(*(claims(s, found) for s in telling()), strict=True)]
    for table in paper().tables:
        lines = [line.row for line in table.rows]
        what = f"table {table.number}: {table.title}"
        cells = f"{len(lines)} rows, {', '.join(table.datasets)}"
        used = [r for r in found if r.row in lines]
        rows.append(
            [
                what,
                cells,
                _progress(lines, table.datasets, used),
                f"`pop-repro table {table.number} --scale small`",
                _commits(used),
            ]
        )
    used = [r for r in found if r.row in beyond_rows() and r.row != "pop"]
    progress = _progress([row for row in beyond_rows() if row != "pop"], DATASETS, used)
    rows.append(
        ["beyond the paper", "not in the paper", progress, "`pop-repro table beyond --scale small`", _commits(used)]
    )
    return grid(["claim or table", "paper", "ours", "command", "commits"], rows)


def files(results: Iterable[Result], folder: Path = HERE) -> dict[Path, str]:
    """Give the text that each generated file should have.

    Raises:
        PopError: a file has no marks for its part.
    """
    found = list(results)
    protocol = _read(folder / "protocol.md")
    protocol = with_part(protocol, "ambiguities", _ambiguities())
    answered = (*claims_page.answers(found), *claims_page.experiments(found))
    protocol = with_part(protocol, "readings", claims_page.answers_markdown(answered))
    table = status_table(found)
    made = {
        folder / "README.md": with_part(_read(folder / "README.md"), "status", table),
        folder / "protocol.md": protocol,
        folder / "claims.md": _claims(found),
    }
    page, front = folder.parent / "docs" / "paper.md", folder.parent / "README.md"
    # only a clone has them
    if page.is_file():
        told = outcome(found)
        made[page] = with_part(with_part(_read(page), "reproduction", table), "settled", told)
        made[front] = with_part(_read(front), "outcome", told)
    return made


def stale_files(results: Iterable[Result]) -> dict[Path, str]:
    """Give those of the generated files that hold something else, with the text that they should have.

    Raises:
        PopError: as `files`.
    """
    return {path: text for path, text in files(results).items() if not path.is_file() or _read(path) != text}


def everything() -> list[Result]:
    """Read the results of all scales that the package holds."""
    return [r for scale in SCALES for r in read_all(scale, RESULTS)]


def with_part(text: str, name: str, part: str) -> str:
    """Put a part between its marks, `<!-- NAME:begin -->` and `<!-- NAME:end -->`.

    Raises:
        PopError: the text has no such marks.
    """
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    before, _, rest = text.partition(begin)
    _, marked, after = rest.partition(end)
    if not marked:
        raise PopError(f"there are no marks {begin} ... {end}; put them where the part belongs")
    return f"{before}{begin}\n{part}\n{end}{after}"


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise PopError(f"{path}: cannot be read ({error.strerror})") from None


def _claim_row(by_scale: Sequence[Claim], found: Sequence[Result]) -> list[str]:
    """Say of one claim what each scale decides: a verdict of one scale alone would hide that another disagrees."""
    named = list(zip(telling(), by_scale, strict=True))
    judged = [(scale, c) for scale, c in named if c.verdict != "not decided"]
    ours = "; ".join(f"{c.verdict} at scale {scale}: {c.line}" for scale, c in judged)
    scale, told = deciding(named)
    command = f"pop-repro claims --scale {scale}" if judged else next(iter(told.told.deciders), "none")
    runs = {run for _, c in judged or [(scale, told)] for e in c.told.evidence for run in e.runs}
    used = [r for r in found if r.run in runs]
    return [told.says, told.paper, ours or f"not decided: {told.line}", f"`{command}`", _commits(used)]


def _commits(used: Iterable[Result]) -> str:
    known = sorted({r.commit[:7] for r in used if r.commit is not None})
    return ", ".join(known) or "none"


def _progress(rows: Sequence[str], datasets: Sequence[str], used: Sequence[Result]) -> str:
    """Say for each scale how many of its pairs of row and scene have a run; the data sets are the paper's scale's."""
    counts = []
    for scale in telling():
        scenes = SCENES_OF.get(scale) or [s for d in datasets for s in paper().datasets[d]]
        done = {(r.row, r.scene) for r in used if r.scale == scale and r.scene in scenes}
        counts.append(f"{scale}: {len(done)} of {len(rows) * len(scenes)}" if done else f"{scale}: not run")
    return "; ".join(counts)


def _ambiguities() -> str:
    rows = [
        [a.id, a.impact, a.question, a.default, ", ".join(f"`{other}`" for other in a.alternatives) or "none"]
        for a in AMBIGUITIES
    ]
    return grid(["label", "impact", "question", "default here", "can be chosen besides"], rows)


def _claims(found: Sequence[Result]) -> str:
    about = "What is asked: [claims.py](claims.py). What is compared with what: [protocol.md](protocol.md)."
    parts = ["# The paper's claims", _MADE, about, method()]
    # the scale that is meant to decide says which runs it lacks even where it has none
    scales = [scale for scale in telling() if scale == JUDGE or any(r.scale == scale for r in found)]
    parts += [claims_markdown(scale, found).strip() for scale in scales]
    return "\n\n".join(parts) + "\n"


def main(words: Sequence[str]) -> int:
    """Run the script."""
    found = everything()
    if "--write" not in words and "--check" not in words:
        print(status_table(found))
        return 0
    stale = stale_files(found)
    for path, text in stale.items():
        if "--write" in words:
            path.write_text(text, encoding="utf-8")
        else:
            print(f"{path.name}: is not what the results say; {_WRITE}")
    return 0 if "--write" in words or not stale else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
