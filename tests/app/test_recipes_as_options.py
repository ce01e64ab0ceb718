"""The rows of the paper's tables as options of `pop train`: each trains what the oracle's recipe of that name says."""

from __future__ import annotations

from dataclasses import fields

import pytest

from pop_fast.cli.train import arguments
from pop_fast.train.presets import options_for
from pop_ref.constants import PROFILES
from pop_ref.recipes import L1_DIVIDED, RECIPES
from pop_ref.settings import DensityConfig, PopTerm

ROWS = {**RECIPES, **{f"L1 div {n}": recipe for n, recipe in L1_DIVIDED.items()}}


@pytest.mark.parametrize("name", ROWS)
def test_a_row_can_be_trained_from_the_command_line(name):
    recipe, words = ROWS[name], options_for(ROWS[name])
    config, _ = arguments(["scene", *words])
    for kind, said in ((DensityConfig, recipe.density), (PopTerm, recipe)):
        for field in fields(kind):
            assert getattr(config.strategy, field.name) == getattr(said, field.name), field.name
    photometric = (config.photometric, config.lambda_ssim, config.l2_stop_iter, config.ssim_padding)
    assert photometric == (recipe.pixelwise, recipe.lambda_ssim, recipe.l2_stop_iter, recipe.padding)
    assert config.photometric_divisor == pytest.approx(1.0 / recipe.pixel_scale, rel=1e-15)
    assert config.d_ssim_halved == recipe.d_ssim_halved
    assert (config.lr, PROFILES[config.profile]) == (recipe.lr, recipe.profile)
    assert (config.max_steps, config.sh_interval) == (recipe.max_steps, recipe.sh_interval)


def test_rows_differ_and_their_options_are_few():
    named = {name: tuple(options_for(recipe)) for name, recipe in ROWS.items()}
    assert len(set(named.values())) == len(named)
    assert (named["POP"], named["gsplat"], named["3DGS"]) == ((), ("--method", "gsplat"), ("--method", "3dgs"))
    assert named["L2+Blur"] == ("--pop.lambda-pop", "0")
