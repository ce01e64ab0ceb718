"""From a state to a picture, of a splat at rest or of a training between its steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch
from torch import Tensor

from pop_fast.density.shrink import inside, opaque_enough
from pop_fast.io.pictures import colormap_table, id_colors
from pop_fast.train.config import TrainConfig
from pop_fast.train.views import Layers, render_layers
from pop_fast.view.live.state import Box, ViewState
from pop_fast.view.report.sections import depth_picture, depth_range

if TYPE_CHECKING:
    from pop_fast.train.training_run import TrainingRun
    from pop_fast.view.live.server import LiveViewer

# what covers a pixel by less has no depth
_SEEN = 0.1


@dataclass(frozen=True, eq=False)
class Drawing:
    """A picture, uint8 [H, W, 3], and a line that says how to read it."""

    image: np.ndarray
    legend: str


class SplatScene:
    """Gaussians that are drawn again and again.

    Args:
        params: raw parameters; not changed, and not kept in another form.
        config: background, profile and antialiasing are read.
        sh_degree: highest active colour band.
        backend: what renders.
        world_transform: world = world_transform @ the capture's own frame, a similarity. [4, 4]
    """

    def __init__(
        self,
        params: Mapping[str, Tensor],
        config: TrainConfig,
        sh_degree: int,
        backend: Any,
        world_transform: np.ndarray | None = None,
    ) -> None:
        self.params = {name: tensor.detach() for name, tensor in params.items()}
        self.config, self.sh_degree, self._backend = config, sh_degree, backend
        self.world_transform = np.eye(4) if world_transform is None else world_transform
        self._unit = float(np.cbrt(np.linalg.det(self.world_transform[:3, :3])))
        self._chosen: tuple[tuple[float, Box | None], Tensor | None, dict[str, Tensor]] | None = None

    def draw(self, state: ViewState) -> Drawing:
        """Draw a state."""
        rows, params = self._selection(state.min_opacity, state.crop)
        n, whole = len(params["means"]), len(self.params["means"])
        shown = f"{n:,} Gaussians" if n == whole else f"{n:,} of {whole:,} Gaussians"
        if n == 0:
            background = np.round(np.clip(self.config.background, 0.0, 1.0) * np.float64(255.0)).astype(np.uint8)
            return Drawing(np.tile(background, (state.height, state.width, 1)), shown)
        ids = state.mode == "dominant"
        layers = render_layers(self._backend, params, state.camera(), self.config, self.sh_degree, dominance=ids)
        image, legend = self._coloured(state, layers, rows)
        return Drawing(image, f"{shown}{legend}")

    def extent(self) -> Box:
        """Give a box of the capture's own frame that holds nearly all Gaussians, without far outliers."""
        means = self._own_means().numpy()
        if not len(means):
            return (-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)
        low, high = np.quantile(means, [0.01, 0.99], axis=0)
        margin = 0.25 * (high - low) + 1e-6
        return (*(low - margin).tolist(), *(high + margin).tolist())

    def _coloured(self, state: ViewState, layers: Layers, rows: Tensor | None) -> tuple[np.ndarray, str]:
        if state.mode == "dominant":
            assert layers.dominant_ids is not None
            found = layers.dominant_ids
            # a Gaussian keeps its colour whatever else is left out
            whole = found if rows is None else np.append(rows.cpu().numpy(), -1)[found]
            return id_colors(whole), f"; {len(np.unique(whole[whole >= 0])):,} own a pixel, one colour each"
        if state.mode == "opacity":
            level = np.round(255.0 * np.clip(layers.alpha, 0.0, 1.0)).astype(np.uint8)
            return colormap_table("viridis")[level], f"; {layers.alpha.mean():.1%} opaque on average, yellow is all"
        if state.mode == "depth":
            depth = np.where(layers.alpha >= _SEEN, layers.depth / self._unit, np.nan)
            near, far = depth_range([depth])
            return depth_picture(depth, near, far), f"; depth {near:.3g} (yellow) to {far:.3g} units of the capture"
        return np.round(np.clip(layers.image, 0.0, 1.0) * 255.0).astype(np.uint8), ""

    def _selection(self, min_opacity: float, crop: Box | None) -> tuple[Tensor | None, dict[str, Tensor]]:
        """Return which rows are drawn, None for all, and their parameters."""
        if min_opacity <= 0.0 and crop is None:
            return None, self.params
        key = (min_opacity, crop)
        if self._chosen is None or self._chosen[0] != key:
            kept = opaque_enough(self.params, min_opacity)
            if crop is not None:
                kept = kept & inside(self._own_means(), crop).to(kept.device)
            rows = kept.nonzero().squeeze(1)
            self._chosen = (key, rows, {name: tensor[rows] for name, tensor in self.params.items()})
        return self._chosen[1], self._chosen[2]

    def _own_means(self) -> Tensor:
        back = torch.from_numpy(np.linalg.inv(self.world_transform))
        return self.params["means"].cpu().double() @ back[:3, :3].T + back[:3, 3]


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
