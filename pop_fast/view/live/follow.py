"""A training under the viewer: between its steps it shows the Gaussians as they are, and changes nothing of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from pop_fast.view.live.draw import SplatScene

if TYPE_CHECKING:
    from pop_fast.train.training_run import TrainingRun
    from pop_fast.view.live.server import LiveViewer


# of the time at most, however many browsers there are and whatever they ask
_SHARE: Final = 0.5


def scene_of(run: TrainingRun, world_transform: np.ndarray) -> SplatScene:
    """Return the Gaussians of a run as they are now; a later step changes what this draws."""
    degree = run.sh_degree(max(run.step - 1, 0))
    return SplatScene(run.params, run.config, degree, run.backend, world_transform)


def follow(viewer: LiveViewer, run: TrainingRun, world_transform: np.ndarray) -> None:
    """Draw what is due of a run, on its own thread; call it between steps.

    Args:
        viewer: what shows it.
        run: the training.
        world_transform: of its capture.
    """
    # without a browser it costs nothing
    if not viewer.watched:
        return
    note = f"step {run.step:,} of {run.config.max_steps:,}"
    viewer.show(scene_of(run, world_transform), note)
    viewer.draw_due(_SHARE)
