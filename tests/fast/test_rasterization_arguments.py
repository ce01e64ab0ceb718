"""The drop-in's arguments: gsplat 1.5.3's names and defaults, and what is refused, by name."""

from __future__ import annotations

import inspect
import re
from dataclasses import replace
from enum import Enum
from typing import Any

import numpy as np
import pytest
import torch

from pop_fast.api.rasterize import rasterization as program
from pop_fast.api.registry import get_backend
from pop_ref.constants import PAPER
from tests.fast.test_rasterization import cameras, rasterization, scene


class RollingShutterType(Enum):
    """gsplat 1.5.3's enumeration of that name (`gsplat/cuda/_wrapper.py`), which a caller of gsplat passes."""

    ROLLING_TOP_TO_BOTTOM = 0
    ROLLING_LEFT_TO_RIGHT = 1
    ROLLING_BOTTOM_TO_TOP = 2
    ROLLING_RIGHT_TO_LEFT = 3
    GLOBAL = 4


# fmt: off
# names and defaults as `gsplat/rendering.py` of the wheel 1.5.3 spells them; `...` where there is none
GSPLAT_1_5_3: dict[str, Any] = {
    "means": ..., "quats": ..., "scales": ..., "opacities": ..., "colors": ..., "viewmats": ..., "Ks": ...,
    "width": ..., "height": ..., "near_plane": 0.01, "far_plane": 1e10, "radius_clip": 0.0, "eps2d": 0.3,
    "sh_degree": None, "packed": True, "tile_size": 16, "backgrounds": None, "render_mode": "RGB",
    "sparse_grad": False, "absgrad": False, "rasterize_mode": "classic", "channel_chunk": 32, "distributed": False,
    "camera_model": "pinhole", "segmented": False, "covars": None, "with_ut": False, "with_eval3d": False,
    "radial_coeffs": None, "tangential_coeffs": None, "thin_prism_coeffs": None, "ftheta_coeffs": None,
    "rolling_shutter": RollingShutterType.GLOBAL, "viewmats_rs": None,
}
# fmt: on


def test_the_signature_begins_with_gsplat_1_5_3s() -> None:
    parameters = inspect.signature(program).parameters
    assert list(parameters)[: len(GSPLAT_1_5_3)] == list(GSPLAT_1_5_3)
    assert all(p.kind is p.KEYWORD_ONLY for name, p in parameters.items() if name not in GSPLAT_1_5_3)
    for name, default in GSPLAT_1_5_3.items():
        ours = parameters[name].default
        # of the one default that is of a type of gsplat's, ours is None
        assert ours == (parameters[name].empty if default is ... else None if name == "rolling_shutter" else default)


@pytest.mark.parametrize("backend", ["fast", "compiled", "ref"])
def test_every_default_of_gsplat_1_5_3_is_accepted_where_it_is_passed(backend: str) -> None:
    if (reason := get_backend(backend).why_not()) is not None:
        pytest.skip(reason)
    defaults = {name: default for name, default in GSPLAT_1_5_3.items() if default is not ...}
    plain = program(**scene(), **cameras(), backend=backend)
    assert plain[0].std() > 0.0
    for given in (defaults, *({name: default} for name, default in defaults.items()), {"tile_size": None}):
        image, alphas, _ = program(**scene(), **cameras(), **given, backend=backend)
        assert torch.equal(image, plain[0])
        assert torch.equal(alphas, plain[1])


WRONG = {
    "means[3, 1] is nan": {
        "means": lambda t: t.index_put((torch.tensor(3), torch.tensor(1)), torch.tensor(np.nan).double())
    },
    "scales[2, 0] is -1.0": {
        "scales": lambda t: t.index_put((torch.tensor(2), torch.tensor(0)), torch.tensor(-1.0).double())
    },
    "quats[4] is [0.0, 0.0, 0.0, 0.0]": {"quats": lambda t: t.index_fill(0, torch.tensor([4]), 0.0)},
    "opacities[0] is 1.5": {"opacities": lambda t: t.index_fill(0, torch.tensor([0]), 1.5)},
    "quats has shape": {"quats": lambda t: t[:, :3]},
    "scales has dtype": {"scales": lambda t: t.float()},
    "Ks[0] is": {"Ks": lambda t: torch.zeros_like(t)},
    "viewmats[0] is": {"viewmats": lambda t: t * 2.0},
    "width is 0": {"width": lambda _: 0},
    "height is 0": {"height": lambda _: 0},
    "colors has shape": {"colors": lambda t: t[:-1]},
    "means is missing; it must be a torch.Tensor": {"means": lambda _: None},
    "opacities is missing": {"opacities": lambda _: None},
    "colors is missing": {"colors": lambda _: None},
    "quats is missing": {"quats": lambda _: None},
    "viewmats is missing": {"viewmats": lambda _: None},
    "Ks is of type ndarray; it must be a torch.Tensor": {"Ks": lambda t: t.numpy()},
    "width is None; it must be a whole number": {"width": lambda _: None},
    "height is 2.5; it must be a whole number": {"height": lambda _: 2.5},
    "tile_size is '16'; it must be a whole number": {"tile_size": lambda _: "16"},
}


@pytest.mark.parametrize("message", WRONG)
def test_wrong_input_is_named_with_its_index(message: str) -> None:
    given = {**scene(), **cameras()}
    (name, change), *_ = WRONG[message].items()
    with pytest.raises(ValueError, match=re.escape(message)):
        rasterization(**{**given, name: change(given.get(name))})


@pytest.mark.parametrize(
    "argument",
    [
        {"sparse_grad": True},
        {"distributed": True},
        {"camera_model": "fisheye"},
        {"segmented": True},
        {"with_ut": True},
        {"with_eval3d": True},
        {"radial_coeffs": torch.zeros(1, 6)},
        {"rolling_shutter": 1},
        {"rolling_shutter": RollingShutterType.ROLLING_LEFT_TO_RIGHT},
        {"viewmats_rs": torch.eye(4)[None]},
    ],
)
def test_unsupported_arguments_raise_by_name(argument: dict[str, object]) -> None:
    with pytest.raises(NotImplementedError, match=next(iter(argument))):
        rasterization(**scene(), **cameras(), **argument)


@pytest.mark.parametrize("backend", ["fast", "compiled", "ref"])
@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ({"near_plane": float("nan")}, "near_plane is nan; it must be a number"),
        ({"near_plane": -1.0}, "near_plane is -1.0; it must be finite and >= 0"),
        ({"near_plane": float("inf")}, "near_plane is inf; it must be finite and >= 0"),
        ({"far_plane": -1.0}, "far_plane is -1.0; it must be beyond near_plane, which is 0.01"),
        ({"far_plane": float("nan")}, "far_plane is nan; it must be a number"),
        ({"near_plane": 5.0, "far_plane": 4.0}, "far_plane is 4.0; it must be beyond near_plane, which is 5.0"),
        ({"eps2d": float("nan")}, "eps2d is nan; it must be a number"),
        ({"eps2d": -0.3}, "eps2d is -0.3; it must be finite and >= 0 px^2"),
        ({"radius_clip": float("nan")}, "radius_clip is nan; it must be >= 0 px"),
        ({"radius_clip": -1.0}, "radius_clip is -1.0; it must be >= 0 px"),
        ({"profile": 3}, "profile is 3; it must be a name or a pop_ref.constants.Profile"),
        ({"profile": replace(PAPER, alpha_floor=2.0)}, "alpha_floor is 2.0; it must be in (0, 1)"),
        ({"profile": replace(PAPER, alpha_ceiling=1.0)}, "alpha_ceiling is 1.0; it must be between alpha_floor and 1"),
    ],
)
def test_numbers_with_which_nothing_can_be_drawn_raise(backend: str, argument: dict[str, Any], said: str) -> None:
    if (reason := get_backend(backend).why_not()) is not None:
        pytest.skip(reason)
    expected = NotImplementedError if backend == "ref" and "radius_clip" in argument else ValueError
    match = "radius_clip=" if expected is NotImplementedError else re.escape(said)
    with pytest.raises(expected, match=match):
        program(**scene(), **cameras(), **argument, backend=backend)
