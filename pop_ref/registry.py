"""Values by name, to which other packages add theirs: profiles here; methods, backends, losses, formats in `pop_fast`.

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
from typing import Any, Generic, TypeVar, cast

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
            found = self._declared().get(name)
            if found is None:
                raise self._error(f"{self.kind} {name!r} is unknown; use one of {', '.join(self)}")
            value = found
        if isinstance(value, str):
            value = self._imported(name, value)
        self._loaded[name] = value
        return value

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

    def _declared(self) -> Mapping[str, str]:
        return _declared(self.group)

    def look_again(self) -> None:
        """Forget what was imported and which packages are installed: after one was added to the path, or removed."""
        self._loaded.clear()
        _declared.cache_clear()

    def _imported(self, name: str, path: str) -> T:
        place = f"the {self.kind} at {path}"
        module, _, attribute = path.partition(":")
        try:
            value: Any = getattr(importlib.import_module(module), attribute)
        # whatever another package raises while it is imported
        except Exception as error:
            raise self._error(f"{place} cannot be loaded: {error}") from error
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
def _declared(group: str) -> Mapping[str, str]:
    """Return what installed packages declare under a group, by name; looked up once."""
    # 10 ms, which a render by a profile of this package does not wait for
    from importlib.metadata import entry_points

    return {entry.name: entry.value for entry in entry_points(group=group)}
