"""The table of open questions against the code: every place exists and says so, every alternative can be chosen."""

from __future__ import annotations

import ast
import importlib
import inspect
from dataclasses import replace
from typing import Any, get_args, get_type_hints

import pytest

from pop_ref.ambiguities import AMBIGUITIES, Ambiguity
from pop_ref.constants import PROFILES
from pop_ref.density import DensityConfig
from pop_ref.recipes import Recipe

SETTINGS = {"Recipe": Recipe(), "DensityConfig": DensityConfig()}
by_id = pytest.mark.parametrize("ambiguity", AMBIGUITIES, ids=lambda a: a.id)


def source_of(where: str) -> str:
    module_name, _, attribute = where.partition(":")
    module = importlib.import_module(module_name)
    place = getattr(module, attribute)
    return inspect.getsource(place if inspect.isclass(place) or inspect.isfunction(place) else module)


def parsed(text: str) -> Any:
    try:
        return ast.literal_eval(text)
    except ValueError:
        return text


def test_there_are_32_questions_in_order() -> None:
    assert [a.id for a in AMBIGUITIES] == [f"A{k}" for k in range(1, 33)]


@by_id
def test_the_place_that_decides_exists_and_names_the_question(ambiguity: Ambiguity) -> None:
    assert (ambiguity.mark or ambiguity.id) in source_of(ambiguity.where)


@by_id
def test_a_question_that_matters_can_be_answered_otherwise(ambiguity: Ambiguity) -> None:
    assert ambiguity.alternatives or ambiguity.impact != "H"


@by_id
def test_every_alternative_is_a_setting_with_another_default(ambiguity: Ambiguity) -> None:
    for alternative in ambiguity.alternatives:
        setting, _, text = alternative.partition(" = ")
        owner, name = setting.split(".")
        if owner not in SETTINGS:
            place = getattr(importlib.import_module(ambiguity.where.partition(":")[0]), owner)
            assert name in inspect.signature(place).parameters
            continue
        default = getattr(SETTINGS[owner], name)
        value = PROFILES[text] if name == "profile" else parsed(text)
        assert value != default
        assert default is None or type(value) is type(default)
        choices = get_args(get_type_hints(type(SETTINGS[owner]))[name])
        assert not isinstance(value, str) or value in choices
        replace(SETTINGS[owner], **{name: value})
