"""Laws of scale: long lists, many tiles and thousands of Gaussians, drawn as training draws them."""

from __future__ import annotations

import numpy as np

from pop_ref.conformance.assertions import assert_close, assert_close_along_rigid_motions, assert_same_bits
from pop_ref.conformance.capabilities import (
    ALL_BANDS,
    DOMINANCE,
    EXTENTS,
    GRADIENTS,
    INRIAS,
    PRINCIPAL_POINT,
    RENDER,
    SCALE,
)
from pop_ref.conformance.corpus import (
    GRADIENTS as ROWS,
)
from pop_ref.conformance.corpus import (
    PLANS,
    answers,
    corpus_scene,
    picked_pixels,
    unambiguous_cotangents,
    weighted_blocks,
    weighted_runs,
)
from pop_ref.conformance.law import law
from pop_ref.constants import INRIA


def _image(name, *needs):
    def sentence(backend):
        scene, expected = corpus_scene(name), answers(name)
        view = backend.plainly(scene)
        sure, at = expected["unambiguous"], picked_pixels(scene)
        seen = np.concatenate([view.image, view.T_final[..., None]], axis=2)
        picked = sure[at]
        pixels = (seen[at][picked], expected["pixels"][picked], expected["e_pixels"][picked])
        blocks = (weighted_blocks(seen, sure), expected["blocks"], expected["e_blocks"])
        for key, part in (("image", np.s_[..., :3]), ("T_final", np.s_[..., 3])):
            for kind, values in (("scale.pixels", pixels), ("scale", blocks)):
                assert_close(f"{kind}.{key}", *(v[part] for v in values), backend.dtype, against_oracle=True)

    sentence.__name__ = f"test_the_image_of_{name}_is_the_oracles"
    return law("whole", RENDER, *needs)(sentence)


def _integers(name, *needs):
    def sentence(backend):
        scene, expected = corpus_scene(name), answers(name)
        view = backend.render(scene)
        winners = weighted_blocks(view.dominant_ids, expected["decided"])
        assert_same_bits("weighted sums of dominant ids over blocks", winners, expected["winners"])
        if view.n_blended is not None:
            blended = weighted_blocks(view.n_blended, expected["unambiguous"])
            assert_same_bits("weighted sums of blended counts over blocks", blended, expected["blended"])

    sentence.__name__ = f"test_dominant_ids_and_counts_of_{name}_are_the_oracles"
    return law("dominance", RENDER, DOMINANCE, *needs)(sentence)


def _gradients(name, *needs):
    def sentence(backend):
        scene, expected = corpus_scene(name), answers(name)
        found = backend.gradients(scene, *unambiguous_cotangents(scene, expected["smooth"]))
        for key, value in found.items():
            sums = weighted_runs(value) if key in ROWS else value
            given = (sums, expected[f"v_{key}"], expected[f"e_{key}"], backend.dtype)
            if key == "viewmat":
                assert_close_along_rigid_motions("scale.v_viewmat", scene.camera.viewmat, *given)
            else:
                assert_close(f"scale.v_{key}", *given, against_oracle=True)

    sentence.__name__ = f"test_the_gradients_of_{name}_are_the_oracles"
    return law("gradients", GRADIENTS, *needs)(sentence)


for _name, _plan in PLANS.items():
    _needs = (INRIAS,) if _plan.profile == INRIA else (EXTENTS, PRINCIPAL_POINT)
    _needs = (*_needs, *((ALL_BANDS,) if _plan.degree else ()), *(() if _plan.small else (SCALE,)))
    for _make in (_image, _integers, _gradients):
        _test = _make(_name, *_needs)
        globals()[_test.law.sentence.__name__] = _test
del _name, _plan, _needs, _make, _test
