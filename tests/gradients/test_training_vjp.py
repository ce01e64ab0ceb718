"""The gradient of the whole objective by raw parameters, through every stage at once."""

from __future__ import annotations

import numpy as np
import pytest

from pop_ref.recipes import RECIPES, Recipe
from pop_ref.render import render, render_vjp
from pop_ref.training import gaussians_from_params, objective, params_vjp, start
from tests.golden import ten_losses
from tests.gradients.checks import central_gradient

CAMERA, PHOTO = ten_losses.cameras()[1], ten_losses.photographs()[1]
PARAMS = {name: array[4:6] for name, array in ten_losses.first_params().items()}
# one band stands for the others, which are most of all numbers: the raw coefficients are the activated ones
PARAMS["shN"] = PARAMS["shN"][:, :3]


def loss_of(params: dict[str, np.ndarray], recipe: Recipe) -> float:
    gaussians = gaussians_from_params(params)
    return objective(render(gaussians, CAMERA), gaussians, PHOTO, start(params), recipe)[0]


@pytest.mark.parametrize("name", ["POP", "3DGS"])
def test_gradient_by_raw_parameters_matches_differences(name: str) -> None:
    gaussians = gaussians_from_params(PARAMS)
    recipe = RECIPES[name]
    _, v_image, v_opacities = objective(render(gaussians, CAMERA), gaussians, PHOTO, start(PARAMS), recipe)
    analytic = params_vjp(PARAMS, render_vjp(gaussians, CAMERA, v_image), v_opacities)
    for key, array in PARAMS.items():
        # a small step keeps every decision of the render (who is skipped, who wins) as it is
        numeric = central_gradient(lambda x, key=key: loss_of({**PARAMS, key: x}, recipe), array, step=2e-6)
        scale = np.linalg.norm(numeric)
        assert scale > 0.0
        assert np.linalg.norm(analytic[key] - numeric) <= 1e-6 * scale, key
