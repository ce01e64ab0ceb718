"""Colours of a view by the compiled library. Meaning: `pop_ref.splatting`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pop_fast.camera import view_dirs_vjp
from pop_fast.compiled.library import Colors, ColorsBackward, call_library


def colors_of_view(sh: Tensor, means: Tensor, viewmat: Tensor, degree: int, visible: Tensor) -> Tensor:
    """Evaluate harmonics for the visible Gaussians; zero for the others. [N, 3]

    Optimizations: one pass over the coefficients forward and one backward (`colors.h`).

    Args:
        sh: coefficients. [N, n_sh, 3]
        means: centres, world units. [N, 3]
        viewmat: world -> camera. [4, 4]
        degree: bands to use.
        visible: rows to evaluate, ascending. [V] int64
    """
    return _Colors.apply(sh, means, viewmat, degree, visible)


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh: Tensor, means: Tensor, viewmat: Tensor, degree: int, visible: Tensor) -> Tensor:
        colors = sh.new_empty((3, len(sh)))
        given = {"sh": sh, "means": means, "viewmat": viewmat, "visible": visible, "colors": colors}
        call_library(Colors, sh.dtype, _numbers(sh, degree, visible), given)
        ctx.degree = degree
        ctx.save_for_backward(sh, means, viewmat, visible)
        return colors.T

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colors: Tensor) -> tuple[Tensor | None, ...]:
        sh, means, viewmat, visible = ctx.saved_tensors
        v_sh, v_dirs = torch.empty_like(sh, memory_format=torch.contiguous_format), sh.new_empty((len(sh), 3))
        given = {"sh": sh, "means": means, "viewmat": viewmat, "visible": visible}
        given |= {"v_colors": v_colors, "v_sh": v_sh, "v_dirs": v_dirs}
        call_library(ColorsBackward, sh.dtype, _numbers(sh, ctx.degree, visible), given)
        if not ctx.needs_input_grad[2]:
            return v_sh, v_dirs, None, None, None
        _, v_viewmat = view_dirs_vjp(means.index_select(0, visible), viewmat, v_dirs.index_select(0, visible))
        return v_sh, v_dirs, v_viewmat, None, None


def _numbers(sh: Tensor, degree: int, visible: Tensor) -> dict[str, float]:
    sizes = {"n": len(sh), "n_visible": len(visible), "n_sh": sh.shape[1]}
    return {**sizes, "degree": degree, "threads": torch.get_num_threads()}
