"""Covariances, projection and colours of the compiled library beside those of torch; the laws judge whole images."""

from __future__ import annotations

from types import ModuleType

import pytest
import torch
from torch import Tensor

from pop_fast import compiled
from pop_fast.compiled import splatting as in_cpp
from pop_fast.stages import splatting
from pop_fast.stages.splatting import ProjectionSettings
from pop_ref.constants import GSPLAT_1_6, INRIA, PAPER, Profile

pytestmark = pytest.mark.skipif(not compiled.available(), reason=compiled.why_not() or "")

WIDTH, HEIGHT = 45, 38


def projected(stages: ModuleType, profile: Profile, antialiased: bool, n: int = 3000) -> tuple[list[Tensor], ...]:
    """Project Gaussians around a camera, and pull a cotangent of all that is shown back to everything."""
    generator = torch.Generator().manual_seed(1)

    def normal(*size: int) -> Tensor:
        return torch.randn(size, generator=generator, dtype=torch.float64)

    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[2, 3] = torch.linalg.qr(normal(3, 3)).Q, 3.0
    inputs = [2.0 * normal(n, 3), normal(n, 4), torch.exp(normal(n, 3) - 2.0), torch.sigmoid(normal(n)), viewmat]
    leaves = [tensor.requires_grad_() for tensor in inputs]
    means, quats, scales, opacities, viewmat = leaves
    K = torch.tensor([[40.0, 0.0, 21.0], [0.0, 37.0, 20.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    view = ProjectionSettings(K, WIDTH, HEIGHT, profile, antialiased)
    found = stages.project(means, stages.covariances(quats, scales), opacities, viewmat, view)
    shown = (found.radii > 0).all(1)
    names = ["means2d", "depths", "conics", "opacities", *(["compensations"] if antialiased else [])]
    values = [getattr(found, name)[shown] for name in names]
    gradients = torch.autograd.grad(values, leaves, [normal(*value.shape) for value in values])
    return [found.radii], [value.detach() for value in values], [*gradients]


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("profile", [PAPER, GSPLAT_1_6, INRIA], ids=lambda profile: profile.name)
def test_projections_are_those_of_torch(profile: Profile, antialiased: bool) -> None:
    (mine, my_values, my_gradients), (its, values, gradients) = (
        projected(stages, profile, antialiased) for stages in (in_cpp, splatting)
    )
    assert torch.equal(mine[0], its[0])
    assert 1000 < int((its[0] > 0).all(1).sum()) < 2500
    for found, expected in zip((*my_values, *my_gradients), (*values, *gradients), strict=True):
        torch.testing.assert_close(found, expected, rtol=0.0, atol=1e-12 * float(expected.abs().max()))


def test_the_cameras_gradient_does_not_depend_on_the_number_of_threads() -> None:
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            results.append(projected(in_cpp, PAPER, antialiased=False)[2])
    finally:
        torch.set_num_threads(before)
    for others in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], others, strict=True))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_of_a_view_are_those_of_torch(degree: int) -> None:
    generator = torch.Generator().manual_seed(5)
    # more than a thread takes at a time, coefficients of bands that are not evaluated, colours under 0
    n = 3000
    sh = torch.randn(n, 16, 3, generator=generator, dtype=torch.float64)
    means = torch.randn(n, 3, generator=generator, dtype=torch.float64)
    viewmat = torch.linalg.qr(torch.randn(4, 4, generator=generator, dtype=torch.float64))[0]
    visible = (torch.rand(n, generator=generator) < 0.7).nonzero().squeeze(1)
    v_colors = torch.randn(n, 3, generator=generator, dtype=torch.float64)
    results = []
    for stage in (splatting.colors_of_view, in_cpp.colors_of_view):
        leaves = [tensor.clone().requires_grad_() for tensor in (sh, means, viewmat)]
        colors = stage(*leaves, degree, visible)
        results.append([colors.detach(), *torch.autograd.grad(colors, leaves, v_colors)])
    assert bool((results[0][0] == 0.0).all(1).any())
    assert bool((results[0][0][visible] == 0.0).any())
    for its, mine in zip(*results, strict=True):
        torch.testing.assert_close(mine, its, rtol=0.0, atol=1e-12 * max(1.0, float(its.abs().max())))


@pytest.mark.parametrize("shown", [[], [0], [6], [2, 3]])
def test_gradients_of_unseen_gaussians_are_zero(shown: list[int]) -> None:
    sh, means = torch.ones(7, 4, 3, requires_grad=True), torch.rand(7, 3, requires_grad=True)
    colors = in_cpp.colors_of_view(sh, means, torch.eye(4), 1, torch.tensor(shown, dtype=torch.int64))
    v_sh, v_means = torch.autograd.grad(colors.sum(), (sh, means))
    assert v_sh.flatten(1).any(1).nonzero().squeeze(1).tolist() == shown
    assert set(v_means.any(1).nonzero().squeeze(1).tolist()) <= set(shown)
    assert bool(v_means.isfinite().all())


MASK = torch.tensor([True, False, True])


@pytest.mark.parametrize(
    ("visible", "words"),
    [
        (
            MASK,
            r"is a tensor of torch.bool and shape \[3\]; .* of a mask these are mask.nonzero\(\).squeeze\(1\)",
        ),
        (MASK.nonzero(), r"shape \[2, 1\]; it must hold the numbers of the rows to evaluate, torch.int64 \[V\]"),
        (torch.tensor([0, 2], dtype=torch.int32), "visible is a tensor of torch.int32"),
        (torch.tensor([0, 3]), "visible names row 0 to 3; there are 3"),
        (torch.tensor([-1, 2]), "visible names row -1 to 2; there are 3"),
    ],
    ids=["mask", "columns", "int32", "beyond", "negative"],
)
def test_rows_that_are_none_are_refused_before_they_are_read(visible: Tensor, words: str) -> None:
    sh, means = torch.ones(3, 4, 3), torch.ones(3, 3)
    with pytest.raises(ValueError, match=words):
        in_cpp.colors_of_view(sh, means, torch.eye(4), 1, visible)
    shown = in_cpp.colors_of_view(sh, means, torch.eye(4), 1, MASK.nonzero().squeeze(1))
    assert (shown != 0.0).any(1).tolist() == MASK.tolist()
