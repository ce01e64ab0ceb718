"""What a run refuses before it takes a step: what would stop it at its first step, or at its first measurement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor

from pop_fast.api.checks import Checks
from pop_fast.errors import PopError
from pop_fast.stages.backend import FAST
from pop_fast.train.config import TrainConfig
from pop_fast.train.metrics import too_small
from pop_fast.train.model import first_unusable
from pop_fast.train.views import ViewTensors


def check_views(config: TrainConfig, name: str, train: Sequence[ViewTensors], test: Sequence[ViewTensors]) -> None:
    """Check the cameras of all views, and that each photograph can be compared as the settings ask.

    Args:
        config: `ssim_padding` is read.
        name: the capture's.
        train: views to train on.
        test: held-out views, which are always measured by whole windows.

    Raises:
        PopError: names the capture, the view and what to do.
    """
    for view in (*train, *test):
        try:
            checks = Checks(FAST, view.viewmat.dtype)
            checks.cameras(view.viewmat, view.K, view.width, view.height, 1, ())
            checks.values()
        except ValueError as error:
            raise PopError(f"{name}: camera of {view.name}: {error}; correct it, or leave the view out") from error
    in_loss = too_small(train) if config.ssim_padding == "valid" else None
    measured = too_small(test)
    if in_loss or measured:
        instead = " ".join([*(["--ssim-padding same"] if in_loss else []), *(["--test-every 0"] if measured else [])])
        raise PopError(f"{name}: {in_loss or measured}; use larger images (a lower --factor), or {instead}")


def check_start(name: str, initial: Mapping[str, Tensor]) -> None:
    """Check that the first Gaussians can be rendered.

    Args:
        name: the capture's.
        initial: raw parameters.

    Raises:
        PopError: an entry is not finite, or a scale is too large for a float; names it and what to do.
    """
    found = first_unusable(initial)
    if found:
        key, index, value = found
        raise PopError(
            f"{name}: {key}{index} of the first Gaussians is {value}; lower --init-scale, "
            "or remove sparse points that are far from all others"
        )
