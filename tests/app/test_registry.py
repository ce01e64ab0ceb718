"""Backends of other packages: found under their entry point, drawn with by the same front end."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import EntryPoint, EntryPoints

import pytest
import torch

from pop_fast.api import registry
from pop_fast.api.rasterize import rasterization
from pop_fast.errors import PopError
from pop_fast.stages.backend import FAST
from tests.fast.test_rasterization import cameras, scene

FOREIGN = replace(FAST, name="foreign", speed=None)
LOADED = registry._loaded


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """As where another package has registered two backends, one of which is not there."""
    here = [("foreign", f"{__name__}:FOREIGN"), ("broken", "no_such_package:BACKEND")]
    found = EntryPoints(EntryPoint(name, value, registry.GROUP) for name, value in here)
    registry._foreign.cache_clear()
    monkeypatch.setattr(registry, "entry_points", lambda group: found.select(group=group))
    monkeypatch.setattr(registry, "_loaded", lambda path: FOREIGN if path == here[0][1] else LOADED(path))
    yield
    registry._foreign.cache_clear()


def test_a_registered_backend_is_known_by_its_name_and_draws(installed: None) -> None:
    assert registry.backend_names() == ("fast", "compiled", "cuda", "ref", "foreign", "broken")
    assert registry.get_backend("foreign") is FOREIGN
    drawn = rasterization(**scene(), **cameras(), backend="foreign")[0]
    assert torch.equal(drawn, rasterization(**scene(), **cameras(), backend="fast")[0])
    assert torch.equal(drawn, rasterization(**scene(), **cameras(), backend=FOREIGN)[0])


def test_one_that_cannot_be_loaded_is_named(installed: None) -> None:
    with pytest.raises(PopError, match=r"the backend at no_such_package:BACKEND cannot be loaded: No module named"):
        registry.get_backend("broken")
