"""Every mutant dies by the law that its entry names, and that law holds on the oracle."""

from __future__ import annotations

import pytest

from pop_ref.conformance.mutants import MUTANTS
from pop_ref.conformance.mutants.copies import Mutant
from pop_ref.conformance.mutants.trial import killed_by, law_named


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_the_named_law_kills_the_mutant(mutant: Mutant) -> None:
    assert killed_by(mutant) is not None, f"{mutant.name} survives {mutant.law}"


def test_there_are_at_least_twenty_mutants_and_no_two_alike() -> None:
    assert len(MUTANTS) >= 20
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS)
    assert len({(mutant.file, mutant.new) for mutant in MUTANTS}) == len(MUTANTS)


def test_each_change_is_one_place_of_one_file() -> None:
    for mutant in MUTANTS:
        assert mutant.broken_source()
        assert law_named(mutant.law).name == mutant.law.partition(":")[2]
