"""Room for instances follows the need: no overflow at once, no memory kept for a phase that is over, no thrashing."""

from __future__ import annotations

import pytest

from cuda_ext.render.capacity import GROWTH, MOST, Capacity

BIG, SMALL = (1000, 800), (500, 400)


def drawn(capacity, counts):
    for view, count in enumerate(counts):
        capacity.note(view, count)


def of_one_view(instances: int) -> Capacity:
    """Return what is known after a step of 1,000 Gaussians had so many instances."""
    capacity = Capacity([BIG])
    capacity.settle(1000)
    capacity.note(0, instances)
    return capacity


def test_the_first_room_is_a_guess_and_never_nothing():
    capacity = Capacity([BIG])
    capacity.settle(1000)
    assert capacity.room(BIG) == 8000
    nobody = Capacity([BIG])
    nobody.settle(0)
    assert nobody.room(BIG) == 1024


def test_after_a_phase_of_fat_splats_the_room_shrinks_to_what_is_needed():
    capacity = Capacity([BIG] * 3)
    capacity.settle(1000)
    assert capacity.overflowed(1, 90_000) == BIG
    assert capacity.room(BIG) == pytest.approx(GROWTH * 90_000, abs=1)
    drawn(capacity, [2000, 3000, 1000])
    assert capacity.room(BIG) == pytest.approx(GROWTH * 90_000, abs=1)
    capacity.settle(1000)
    assert capacity.room(BIG) == pytest.approx(GROWTH * 3000, abs=1)


def test_the_heaviest_view_counts_although_the_last_window_passed_it_by():
    capacity = Capacity([BIG] * 3)
    capacity.settle(1000)
    capacity.room(BIG)
    drawn(capacity, [2000, 9000, 1000])
    for _ in range(5):
        capacity.note(0, 2000)
        capacity.settle(1000)
    assert capacity.room(BIG) >= 9000 * 1.2


def test_a_need_that_varies_a_little_moves_no_memory():
    capacity = of_one_view(10_000)
    capacity.settle(1000)
    rooms = set()
    for count in (10_500, 9500, 11_000, 8000, 12_000, 10_000) * 5:
        capacity.note(0, count)
        capacity.settle(1000)
        rooms.add(capacity.room(BIG))
        assert capacity.room(BIG) >= 1.2 * count
    assert len(rooms) == 1


def test_a_population_that_doubles_has_room_before_it_overflows():
    capacity = of_one_view(10_000)
    capacity.settle(2000)
    assert capacity.room(BIG) >= 20_000 * 1.2


def test_a_room_that_would_overflow_soon_grows_before_it_does():
    capacity = Capacity([BIG])
    capacity.settle(1000)
    capacity.overflowed(0, 10_000)
    capacity.note(0, 14_900)
    capacity.settle(1000)
    assert capacity.room(BIG) == pytest.approx(GROWTH * 14_900, abs=1)


def test_every_size_has_a_room_of_its_own_and_a_new_size_is_judged_by_its_pixels():
    capacity = Capacity([BIG, BIG, SMALL])
    capacity.settle(1000)
    capacity.room(BIG)
    drawn(capacity, [40_000, 20_000])
    capacity.settle(1000)
    assert capacity.room(BIG) == pytest.approx(GROWTH * 40_000, abs=1)
    assert capacity.room(SMALL) == pytest.approx(GROWTH * 10_000, abs=1)
    assert capacity.overflowed(2, 30_000) == SMALL
    assert capacity.room(SMALL) == pytest.approx(GROWTH * 30_000, abs=1)
    assert capacity.room(BIG) == pytest.approx(GROWTH * 40_000, abs=1)


def test_a_need_beyond_the_kernels_numbers_stays_what_it_is_and_one_below_gets_what_there_is():
    capacity = Capacity([BIG])
    capacity.settle(1000)
    capacity.overflowed(0, MOST - 5)
    assert capacity.room(BIG) == MOST
    capacity.overflowed(0, 2**31 - 1)
    assert capacity.room(BIG) == 2**31 - 1


def test_what_a_doubled_population_may_need_is_not_refused_before_it_is_needed():
    capacity = Capacity([BIG])
    capacity.settle(1000)
    capacity.note(0, MOST - 5)
    capacity.settle(2000)
    assert capacity.room(BIG) == MOST
