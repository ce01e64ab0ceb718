"""Laws of dominance: which splat wins a pixel, and how many each wins (D8)."""

from __future__ import annotations

import dataclasses

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close, assert_same_bits, assert_seen, with_error_bounds
from pop_ref.conformance.capabilities import DOMINANCE, DOMINANT_COUNTS, DOMINANT_WEIGHTS, PROFILES, RENDER
from pop_ref.conformance.law import law
from pop_ref.conformance.laws.test_compositing import colored
from pop_ref.conformance.scenes import Record, Scene, pack
from pop_ref.conformance.strategies import arrays_of, corners, dyadic, plain_sizes, scenes
from pop_ref.constants import PAPER
from pop_ref.records import Camera

plain = scenes(anchored=True, size=plain_sizes())
maps = st.lists(st.integers(-1, 3), min_size=6, max_size=6).map(lambda ids: np.array(ids).reshape(2, 3))
contenders = st.lists(st.tuples(st.integers(0, 9), dyadic(0.0, 1.0)), max_size=6)


@law("dominance", "dominant_id", contenders=contenders)
def test_the_largest_weight_wins_and_ties_go_to_the_front(backend, contenders):
    ids, weights = [c[0] for c in contenders], [c[1] for c in contenders]
    winner = backend.stage("dominant_id")(ids, weights)
    if not contenders or max(weights) == 0.0:
        assert winner == -1
    else:
        assert winner == ids[weights.index(max(weights))]


@law("dominance", "dominant_counts", ids=maps)
def test_counts_and_empty_pixels_add_up_to_the_image(backend, ids):
    counts = backend.stage("dominant_counts")(ids, 4)
    assert int(np.sum(counts)) + int(np.sum(ids < 0)) == ids.size
    assert_same_bits("counts", counts, [int(np.sum(ids == i)) for i in range(4)])


@law("dominance", "dominant_counts", ids=maps, cut=st.integers(0, 3))
def test_counts_add_over_crops(backend, ids, cut):
    count = backend.stage("dominant_counts")
    left, right = np.ascontiguousarray(ids[:, :cut]), np.ascontiguousarray(ids[:, cut:])
    assert_same_bits("counts", count(left, 4) + count(right, 4), count(ids, 4))


@law("dominance", RENDER, DOMINANCE, DOMINANT_COUNTS, first=corners(), scene=scenes())
def test_the_counts_of_a_render_are_those_of_its_map(backend, scene):
    n = len(scene.gaussians)
    view = backend.render(backend.sees(scene))
    assert np.all((view.dominant_ids >= -1) & (view.dominant_ids < max(n, 1)))
    assert_same_bits("counts", view.dominant_counts, [int(np.sum(view.dominant_ids == i)) for i in range(n)])
    assert int(np.sum(view.dominant_counts)) + int(np.sum(view.dominant_ids < 0)) == view.dominant_ids.size


@law("dominance", RENDER, DOMINANCE, first=corners(), scene=scenes())
def test_a_pixel_without_blended_splats_belongs_to_nobody(backend, scene):
    seen, error_bounds = with_error_bounds(backend, scene)
    view = backend.render(seen)
    nobody = view.dominant_ids < 0
    assert_same_bits("remaining transmittance of empty pixels", view.T_final[nobody], np.ones(int(np.sum(nobody))))
    if view.dominant_weights is not None:
        assert_same_bits("weights of empty pixels", view.dominant_weights[nobody], np.zeros(int(np.sum(nobody))))
    if view.n_blended is not None:
        # what counts may be drawn anew, and decide for itself where rounding does
        sure = error_bounds.unambiguous
        assert_same_bits("empty pixels", (view.n_blended == 0)[sure], nobody[sure])


@law("dominance", RENDER, DOMINANCE, first=corners(), scene=plain)
def test_the_winner_is_the_splat_whose_weight_shows_most_in_the_image(backend, scene):
    # a Gaussian that is white among black ones paints its own weight
    seen, error_bounds = with_error_bounds(backend, scene.with_overrides(background=np.zeros(3)))
    view = backend.render(seen)
    assert_seen(view)
    n = len(scene.gaussians)
    weights = np.stack(
        [backend.render(colored(seen, np.eye(n)[:, i : i + 1] * np.ones(3))).image[..., 0] for i in range(n)]
    )
    largest = np.max(weights, axis=0)
    sure = error_bounds.decided & (largest > 0.0)
    magnitude = 2.0 * error_bounds.T_final + 1.0
    if view.dominant_weights is not None:
        assert_close("dominance.weight", view.dominant_weights[sure], largest[sure], magnitude[sure], backend.dtype)
    assert_same_bits("winner", view.dominant_ids[sure], np.argmax(weights, axis=0)[sure])


@law(
    "dominance",
    RENDER,
    DOMINANCE,
    scene=plain,
    colors=arrays_of((7, 3), 0.0, 2.0),
    background=arrays_of((3,), 0.0, 1.0),
)
def test_colours_and_background_do_not_matter(backend, scene, colors, background):
    seen = backend.sees(scene)
    painted = backend.sees(colored(scene, colors[: len(scene.gaussians)]).with_overrides(background=background))
    one, other = backend.render(seen), backend.render(painted)
    assert_same_bits("winner", one.dominant_ids, other.dominant_ids)
    if one.dominant_weights is not None:
        assert_same_bits("weight", one.dominant_weights, other.dominant_weights)


@law("dominance", RENDER, DOMINANCE, opacity=st.sampled_from([0.5, 0.25, 0.75]), copies=st.integers(2, 4))
def test_of_coincident_copies_only_the_first_in_memory_dominates(backend, opacity, copies):
    camera = Camera(np.eye(4), np.array([[8.0, 0, 2.5], [0, 8.0, 2.5], [0, 0, 1]]), 5, 5)
    records = [Record(2.5, 2.5, 1.0, (2.0, 2.0, 2.0), opacity=opacity)] * copies
    view = backend.render(backend.sees(Scene(pack(records, camera), camera)))
    won = np.unique(view.dominant_ids)
    assert_same_bits("winners", won[won >= 0], [0])


@law("dominance", RENDER, DOMINANCE, DOMINANT_WEIGHTS, PROFILES, more=st.integers(0, 2))
def test_an_exact_tie_goes_to_the_front(backend, more):
    # the largest number below 1 as ceiling, half of it in front: what is left of the light rounds to one half, so that
    # both weigh the same to the bit
    ceiling = float(np.nextafter(np.ones(1, backend.dtype), 0.0, dtype=backend.dtype)[0])
    profile = dataclasses.replace(PAPER, name="open", alpha_ceiling=ceiling, transmittance_stop=0.0)
    camera = Camera(np.eye(4), np.array([[8.0, 0, 0.5], [0, 8.0, 0.5], [0, 0, 1]]), 1, 1)
    stack = [Record(0.5, 0.5, 4.0, opacity=1.0), Record(0.5, 0.5, 2.0, opacity=0.5 * ceiling)]
    behind = [Record(0.5, 0.5, 8.0 + k, opacity=1.0) for k in range(more)]
    seen = backend.sees(Scene(pack(stack + behind, camera), camera, np.zeros(3), profile))
    n = len(stack + behind)
    # a backend whose exponents round may break the tie, and then has to say so with its own weights
    painted = [
        float(backend.render(colored(seen, np.eye(n)[:, i : i + 1] * np.ones(3))).image[0, 0, 0]) for i in (1, 0)
    ]
    view = backend.render(seen)
    assert_same_bits("weight", view.dominant_weights, [[max(painted)]])
    assert_same_bits("winner", view.dominant_ids, [[1 if painted[0] >= painted[1] else 0]])
