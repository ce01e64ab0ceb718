"""The notation table is complete and says what the value types say."""

from __future__ import annotations

from dataclasses import fields

import pytest

from pop_ref.notation import AXES, SYMBOLS, symbol_named
from pop_ref.records import Camera, Gaussians, Render, Splats

# containers, not symbols
_CONTAINERS = {"splats"}


def test_no_symbol_stands_twice() -> None:
    names = [s.name for s in SYMBOLS]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("kind", [Gaussians, Camera, Splats, Render], ids=lambda k: k.__name__)
def test_every_field_of_a_value_type_is_in_the_table_with_the_same_shape(kind: type) -> None:
    for field in fields(kind):
        if field.name in _CONTAINERS:
            continue
        shape = symbol_named(field.name).shape
        annotation = str(field.type)
        if '"' in annotation:
            assert annotation.split('"')[1].split() == shape.strip("[]").replace(",", "").split(), field.name


def test_every_axis_in_a_shape_is_explained() -> None:
    for symbol in SYMBOLS:
        if symbol.shape.startswith("["):
            for axis in symbol.shape.strip("[]").split(", "):
                assert axis.isdigit() or axis in AXES, symbol.name


def test_an_unknown_symbol_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="'rotation' is not in the notation table"):
        symbol_named("rotation")
