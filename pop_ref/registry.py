"""Values by name, to which other packages add theirs: profiles here; methods, backends, losses, ... in `pop_fast`.

A registry knows three kinds of names: those of the package that it belongs to, those that a program registers while it
runs, and those that installed packages declare under an entry point group, as

    [project.entry-points."pop_splatting.profiles"]
    mine = "my_package:MY_PROFILE"

A value may be given as such a text, and is then imported when it is first asked for: to list names imports nothing.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

__all__ = ["Registry"]

T = TypeVar("T")


class Registry(Mapping[str, T], Generic[T]):
    """A mapping of names to values of one kind.

    Args:
        kind: what the values are, in one word, for errors.
        group: entry point group under which other packages declare theirs.
        own: the names of the package itself, with values or `module:attribute`.
        needs: attributes that every value must have.
        error: what is raised for a name that is unknown.

    Example:
        >>> colors = Registry("color", "example.colors", {"red": 1})
        >>> colors.register("blue", 2)
        >>> list(colors), colors.named("blue")
        (['red', 'blue'], 2)
        >>> colors.named("green")
        Traceback (most recent call last):
        ValueError: color 'green' is unknown; use one of red, blue
    """

    def __init__(
        self,
        kind: str,
        group: str,
        own: Mapping[str, T | str] | None = None,
        needs: tuple[str, ...] = (),
        error: type[ValueError] = ValueError,
    ) -> None:
        self.kind, self.group = kind, group
        self._needs, self._error = needs, error
        self._given: dict[str, T | str] = dict(own or {})
        self._loaded: dict[str, T] = {}

    def register(self, name: str, value: T | str) -> None:
        """Add a value, or the `module:attribute` where it will be found.

        Args:
            name: that nothing else has here.
            value: with the attributes that the registry asks for.

        Raises:
            ValueError: the name is taken by another value, or the value lacks an attribute.
        """
        if self._given.get(name, value) != value:
            raise self._error(f"{self.kind} {name!r} is registered already; give yours another name")
        if not isinstance(value, str):
            self._check(name, value, f"the value registered as {self.kind} {name!r}")
        self._given[name] = value

    def named(self, name: str) -> T:
        """Return the value of a name.

        Raises:
            ValueError: there is none, it cannot be imported, or it is none of this kind; says which.
        """
        if name in self._loaded:
            return self._loaded[name]
        value = self._given.get(name)
        if value is None:
            value = self._of_another(name)
        elif isinstance(value, str):
            value = self._imported(name, value, value)
        self._loaded[name] = value
        return value

    def usable(self) -> Iterator[tuple[str, T]]:
        """Give all names with their values, but for those of other packages that cannot be loaded."""
        for name in self:
            try:
                value = self.named(name)
            except self._error:
                if name in self._given:
                    raise
                continue
            yield name, value

    def packages(self, name: str) -> tuple[str, ...]:
        """Return the packages that declare a name, each with its version; none for a name of the package itself."""
        if name in self._given:
            return ()
        return tuple(_package(entry) for entry in self._declared().get(name, ()))

    def added(self) -> Iterator[tuple[str, str, str | None]]:
        """Give what other packages declare: the name, whose it is, and why it cannot be used, or None."""
        for name, entries in self._declared().items():
            package, fault = " and ".join(sorted(map(_package, entries))), None
            try:
                self.named(name)
            except self._error as error:
                fault = str(error)
            if name in self._given:
                fault = f"that of {package} is not used; another {self.kind} has its name"
            yield name, package, fault

    def __getitem__(self, name: str) -> T:
        if name not in self:
            raise KeyError(name)
        return self.named(name)

    def __contains__(self, name: object) -> bool:
        # a name of the package itself is known without a look at what is installed
        return name in self._given or name in self._declared()

    def __iter__(self) -> Iterator[str]:
        yield from self._given
        yield from (name for name in self._declared() if name not in self._given)

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __repr__(self) -> str:
        return f"Registry({self.kind!r}, {self.group!r}: {', '.join(self)})"

    def _declared(self) -> Mapping[str, tuple[EntryPoint, ...]]:
        return _declared(self.group)

    def look_again(self) -> None:
        """Forget what was imported and which packages are installed: after one was added to the path, or removed."""
        self._loaded.clear()
        _declared.cache_clear()

    def _of_another(self, name: str) -> T:
        """Return the value of a name that another package declares."""
        entries = self._declared().get(name)
        if not entries:
            raise self._error(f"{self.kind} {name!r} is unknown; use one of {', '.join(self)}")
        entry, *others = entries
        if others:
            both = " and ".join(sorted(map(_package, entries)))
            raise self._error(f"{self.kind} {name!r} is declared by {both}; uninstall all but one of them")
        return self._imported(name, entry, f"{entry.value} of {_package(entry)}")

    def _imported(self, name: str, path: str | EntryPoint, where: str) -> T:
        place = f"the {self.kind} at {where}"
        try:
            if isinstance(path, str):
                module, _, attribute = path.partition(":")
                value: Any = getattr(importlib.import_module(module), attribute)
            else:
                value = path.load()
        # whatever another package raises while it is imported
        except (Exception, SystemExit) as error:
            raise self._error(f"{place} cannot be loaded: {type(error).__name__}: {error}") from error
        self._check(name, value, place)
        return cast("T", value)

    def _check(self, name: str, value: Any, place: str) -> None:
        lacks = [needed for needed in self._needs if not hasattr(value, needed)]
        if lacks:
            raise self._error(
                f"{place} is a {type(value).__name__} without {', '.join(lacks)}, so it is no {self.kind}"
            )
        own = value.name if "name" in self._needs else name
        if own != name:
            raise self._error(f"{place} calls itself {own!r} and is registered as {name!r}; use one name for both")


@functools.cache
def _declared(group: str) -> Mapping[str, tuple[EntryPoint, ...]]:
    """Return what installed packages declare under a group, by name; looked up once."""
    # 10 ms, which a render by a profile of this package does not wait for
    from importlib.metadata import entry_points

    found: dict[str, dict[str, EntryPoint]] = {}
    for entry in entry_points(group=group):
        found.setdefault(entry.name, {}).setdefault(entry.value, entry)
    return {name: tuple(entries.values()) for name, entries in found.items()}


def _package(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else f"the package of {entry.module}"
