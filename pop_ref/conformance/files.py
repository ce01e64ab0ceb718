"""Files that are written whole or not at all, and those of a package, importable once more under another name."""

from __future__ import annotations

import functools
import importlib.abc
import importlib.util
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import CodeType, ModuleType


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file next to its place and rename it, so that a stop or a full disk leaves what was there.

    Args:
        path: its folder is made where there is none; a link is followed. What is no regular file, as a terminal, is
            written to as it is.
        content: text is written as UTF-8.

    Raises:
        OSError: it cannot be written; nothing is left.
    """
    data = content.encode() if isinstance(content, str) else content
    if path.exists() and not path.is_file():
        path.write_bytes(data)
        return
    path = Path(os.path.realpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    try:
        partial.write_bytes(data)
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


@contextmanager
def copied(package: str, name: str, changed: Mapping[str, str]) -> Iterator[None]:
    """Have a copy of a package for the duration of a with statement; the package itself is empty in it.

    Args:
        package: what is copied.
        name: of the copy, of which one lives at a time.
        changed: texts of files, as paths in the package, that differ in the copy.
    """
    finder = _Finder(package, name, changed)
    _forget(name)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
        _forget(name)


@functools.cache
def folder_of(package: str) -> Path:
    """Return where a package's files are."""
    # found without importing it
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError(f"No module named {package!r}", name=package)
    return Path(spec.origin).parent


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def __init__(self, package: str, name: str, changed: Mapping[str, str]) -> None:
        self.package, self.name, self.changed = package, name, changed

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Answer for the copy's names only."""
        if fullname == self.name:
            return importlib.util.spec_from_loader(fullname, self, is_package=True)
        if not fullname.startswith(f"{self.name}."):
            return None
        source = folder_of(self.package) / self._file(fullname)
        if not source.exists():
            return None
        # what stands next to a module is found from where it was copied
        spec = ModuleSpec(fullname, self, origin=str(source), is_package=source.name == "__init__.py")
        spec.has_location = True
        return spec

    def exec_module(self, module: ModuleType) -> None:
        """Run the file's text, or the one in its place."""
        if module.__name__ != self.name:
            file = self._file(module.__name__)
            text = self.changed.get(file)
            code = _sound_code if text is None else functools.partial(_compiled, text)
            exec(code(self.package, self.name, file), module.__dict__)

    def _file(self, fullname: str) -> str:
        stem = fullname.removeprefix(f"{self.name}.").replace(".", "/")
        package = f"{stem}/__init__.py"
        return package if (folder_of(self.package) / package).exists() else f"{stem}.py"


@functools.cache
def _sound_code(package: str, name: str, file: str) -> CodeType:
    return _compiled((folder_of(package) / file).read_text(encoding="utf-8"), package, name, file)


def _compiled(text: str, package: str, name: str, file: str) -> CodeType:
    return compile(text.replace(package, name), f"<{name}/{file}>", "exec")


def _forget(package: str) -> None:
    for name in [n for n in sys.modules if n == package or n.startswith(f"{package}.")]:
        del sys.modules[name]
