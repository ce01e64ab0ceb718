"""Names beside markers: each at its own, none over another, inside the frame where that is possible."""

from __future__ import annotations

import itertools

from paper_repro.figures.names import Marker, along, places

FRAME = (30.0, 70.0, 230.0, 210.0)
# three that stand close together, two that nearly coincide, two that overlap, and two alone
CLUSTERS = [
    Marker(119.4, 187.4, 9.2, 18.0, 14.7),
    Marker(117.8, 192.8, 10.2, 19.7, 14.7),
    Marker(140.6, 89.7, 3.2, 32.6, 14.7),
    Marker(191.6, 118.4, 3.9, 35.8, 14.7),
    Marker(148.0, 139.2, 3.9, 44.2, 14.7),
    Marker(147.7, 136.0, 3.5, 47.4, 14.7),
    Marker(88.4, 150.1, 3.5, 43.2, 14.7),
    Marker(70.5, 153.6, 2.8, 42.4, 14.7),
    Marker(85.0, 158.8, 4.1, 18.0, 14.7),
]


def overlap(a, b):
    return max(min(a[2], b[2]) - max(a[0], b[0]), 0.0) * max(min(a[3], b[3]) - max(a[1], b[1]), 0.0)


def distance(box, marker):
    dx = max(box[0] - marker.x, marker.x - box[2], 0.0)
    dy = max(box[1] - marker.y, marker.y - box[3], 0.0)
    return max((dx * dx + dy * dy) ** 0.5 - marker.radius, 0.0)


def test_a_name_alone_stands_to_the_right_or_where_there_is_room():
    [place] = places([Marker(100.0, 100.0, 4.0, 20.0, 10.0)], FRAME)
    assert place.box == (106.0, 95.0, 126.0, 105.0)
    assert not place.is_joined
    [place] = places([Marker(225.0, 100.0, 4.0, 20.0, 10.0)], FRAME)
    assert place.box[2] == 219.0
    # a line that leads to the right
    [place] = places([Marker(100.0, 100.0, 4.0, 20.0, 10.0)], FRAME, along([(100.0, 100.0), (150.0, 100.0)]))
    assert place.box[2] == 94.0


def test_names_of_close_markers_cover_nothing_and_are_nearest_to_their_own_or_joined_to_it():
    found = places(CLUSTERS, FRAME)
    assert [overlap(a.box, b.box) for a, b in itertools.combinations(found, 2)] == [0.0] * 36
    for marker, place in zip(CLUSTERS, found, strict=True):
        assert overlap(place.box, FRAME) > 0.999 * marker.width * marker.height
        others = [other for other in CLUSTERS if other is not marker]
        assert min(distance(place.box, other) for other in others) > 0.0
        if not place.is_joined:
            assert distance(place.box, marker) <= min(distance(place.box, other) for other in others)
    assert sum(place.is_joined for place in found) <= 2


def test_the_order_of_markers_changes_no_place_of_markers_far_apart():
    apart = [CLUSTERS[2], CLUSTERS[3], CLUSTERS[1]]
    assert places(apart, FRAME) == places(apart[::-1], FRAME)[::-1]
