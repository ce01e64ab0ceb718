"""The hook of `make site`: README.md becomes the first page, and every file that a page links to becomes one.

A link to a chapter's script leads to the chapter's page, which `make walkthrough` has made before.

mkdocs calls `on_files` and `on_page_markdown` (https://www.mkdocs.org/user-guide/configuration/#hooks). Links in the
pages lead to files of the repository, so that they work where it is read; on the site they lead to copies.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(\]\()([^)#\s]+)((?:#[^)\s]*)?\))")
HIGHLIGHTED = {".py": "python", ".cu": "cuda", ".cuh": "cuda", ".toml": "toml", ".json": "json"}
PICTURES = (".png", ".svg")
# the report as HTML, because it is copied to the site after that is built
BUILT_ELSEWHERE = """
## Built with this site

- [The walk-through](learn/index.html): the algorithm step by step, with pictures and exercises.
- <a href="demo/report.html">The demo's report</a>: what `make demo` leaves.
"""
CHAPTER = re.compile(r"pop_ref/walkthrough/(chapter_\w+)\.py")
WALKTHROUGH = ROOT / "out" / "walkthrough"
FORMULA = re.compile(r"\$([^$\n`|]+)\$")


def place(path: str) -> str:
    """Give the place on the site of a file or folder of the repository.

    Args:
        path: relative to the repository's root, with forward slashes.
    """
    if path == "README.md":
        return "index.md"
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    chapter = CHAPTER.fullmatch(path)
    if chapter:
        return f"learn/{chapter[1]}.html"
    return f"source/{path}" if path.endswith((".md", *PICTURES)) else f"source/{path}.md"


def targets(text: str, path: str) -> Iterator[str]:
    """Give the files of the repository that the links of a page lead to; `path` is the page's own."""
    for _, target, _ in LINK.findall(text):
        if "://" not in target:
            yield posixpath.normpath(posixpath.join(posixpath.dirname(path), target))


def with_links_of_the_site(text: str, path: str) -> str:
    """Make the links of a page lead to the places on the site; `path` is the page's own, in the repository."""
    here = posixpath.dirname(place(path))

    def turned(link: re.Match[str]) -> str:
        if "://" in link[2]:
            return link[0]
        target = place(posixpath.normpath(posixpath.join(posixpath.dirname(path), link[2])))
        return f"{link[1]}{posixpath.relpath(target, here or '.')}{link[3]}"

    return LINK.sub(turned, text)


def content(path: str) -> str:
    """Make the Markdown of a file's page: itself, its source, or the names in a folder."""
    file = ROOT / path
    if not file.exists():
        raise FileNotFoundError(f"{path}: a page links to it and it does not exist; correct the link")
    if file.is_dir():
        names = "\n".join(f"- `{child.name}`" for child in sorted(file.iterdir()) if child.name[0] not in "._")
        return f"# {path}\n\n{names}\n"
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".md":
        return text
    # longer than any fence within the file
    fence = "`" * (2 + max((len(run) for run in re.findall(r"`+", text)), default=1))
    return f'# {path}\n\n{fence}{{.{HIGHLIGHTED.get(file.suffix, "text")} linenums="1"}}\n{text}\n{fence}\n'


def linked(start: list[str]) -> dict[str, str]:
    """Give path and Markdown of every file that these pages lead to, over pages in Markdown as far as it goes."""
    found: dict[str, str] = {}
    waiting = [target for path in start for target in targets((ROOT / path).read_text(encoding="utf-8"), path)]
    while waiting:
        path = waiting.pop()
        elsewhere = path == "README.md" or path.startswith("docs/") or CHAPTER.fullmatch(path)
        if path in found or elsewhere or path.endswith(PICTURES):
            continue
        found[path] = content(path)
        if path.endswith(".md"):
            waiting += targets(found[path], path)
    return found


def pictures(texts: dict[str, str]) -> set[str]:
    """Give the pictures outside docs/ that these pages show."""
    return {
        target
        for path, text in texts.items()
        for target in targets(text, path)
        if target.endswith(PICTURES) and not target.startswith("docs/")
    }


def with_formulas(text: str) -> str:
    """Turn formulas, `$...$`, into MathML, which a browser shows without a script."""
    from latex2mathml.converter import convert

    return FORMULA.sub(lambda formula: str(convert(formula[1])), text)


def walkthrough() -> dict[str, bytes]:
    """Give place and content of every file of the walk-through; its pages lead back to the site.

    Raises:
        FileNotFoundError: it has not been built.
    """
    if not (WALKTHROUGH / "index.html").is_file():
        raise FileNotFoundError(f"{WALKTHROUGH} has no index.html; run 'make walkthrough' first")
    found = {}
    for file in sorted(each for each in WALKTHROUGH.rglob("*") if each.is_file()):
        path, content = file.relative_to(WALKTHROUGH).as_posix(), file.read_bytes()
        up = "../" * (1 + path.count("/"))
        home = f'<main><nav><a href="{up}index.html">pop-splatting</a><a href="{up}learn.html">Learn</a></nav>'
        found[f"learn/{path}"] = content.replace(b"<main>", home.encode(), 1)
    return found


def on_files(files: Any, config: Any) -> Any:
    """Add README.md, the walk-through, and all that is linked to."""
    from mkdocs.structure.files import File

    pages = ["README.md", *(f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md"))]
    texts = {path: (ROOT / path).read_text(encoding="utf-8") for path in pages}
    made = linked(pages)
    files.append(File.generated(config, "index.md", content=texts["README.md"] + BUILT_ELSEWHERE))
    for path, text in made.items():
        files.append(File.generated(config, place(path), content=text))
    for place_of_page, page in walkthrough().items():
        files.append(File.generated(config, place_of_page, content=page))
    for path in pictures({**texts, **made}):
        files.append(File.generated(config, place(path), abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Turn a page's links."""
    place_of_page = PurePosixPath(page.file.src_uri)
    if place_of_page.parts[0] != "source":
        path = "README.md" if str(place_of_page) == "index.md" else f"docs/{place_of_page}"
    else:
        path = str(PurePosixPath(*place_of_page.parts[1:]))
        if path.endswith(".md") and not (ROOT / path).is_file():
            path = path.removesuffix(".md")
    # a page of source code holds no links, only what may look like them
    if not path.endswith(".md"):
        return markdown
    return with_formulas(with_links_of_the_site(markdown, path))
