"""What a run learns of its photographs in addition to the scene: their exposures and the corrections of their cameras.

All of it is off unless the settings ask for it; then views and images pass through unchanged, to the same bits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter

from pop_fast.stages.appearance import background_at, centred_exposures, expose, refined_viewmat, without_common_motion
from pop_fast.train.checkpoint import pack_optimizers
from pop_fast.train.config import TrainConfig
from pop_fast.train.model import make_optimizers
from pop_fast.train.views import ViewTensors


class Appearance:
    """Exposures and corrections of the training views, each with its Adam."""

    def __init__(self, config: TrainConfig, views: Sequence[ViewTensors]) -> None:
        self._config = config
        dtype = views[0].viewmat.dtype
        start = {
            "exposures": torch.eye(3, 4, dtype=dtype).repeat(len(views), 1, 1) if config.exposure else None,
            "cameras": torch.zeros(len(views), 6, dtype=dtype) if config.refine_cameras else None,
        }
        self.params = {name: Parameter(value) for name, value in start.items() if value is not None}
        self._optimizers = make_optimizers(self.params)
        self._viewmats = torch.cat([view.viewmat for view in views])

    def _photo(self, index: int) -> int:
        # the same photograph shrunk is as many places further on; see `pop_fast.train.views`
        return index % len(self._viewmats)

    def seen_from(self, view: ViewTensors, index: int) -> ViewTensors:
        """Return a training view with its corrected camera."""
        if "cameras" not in self.params:
            return view
        return replace(view, viewmat=refined_viewmat(view.viewmat[0], self.params["cameras"][self._photo(index)])[None])

    def seen(self, views: Sequence[ViewTensors]) -> Sequence[ViewTensors]:
        """Return all training views with their cameras as they are corrected whenever one is asked for."""
        return _Refined(self, views) if "cameras" in self.params else views

    def exposed(self, image: Tensor, index: int) -> Tensor:
        """Return a render of a training view [H, W, 3] in the colours of its photograph."""
        if "exposures" not in self.params:
            return image
        return expose(image, self.params["exposures"][self._photo(index)])

    def exposure(self, index: int) -> Tensor:
        """Return the exposure of a training view's photograph, without its graph [3, 4]."""
        return self.params["exposures"].detach()[self._photo(index)]

    def pull_exposure(self, index: int, gradient: Tensor) -> None:
        """Take the gradient of a training view's exposure [3, 4] from a step that is no graph; see `update`."""
        exposures = self.params["exposures"]
        exposures.grad = torch.zeros_like(exposures)
        exposures.grad[self._photo(index)] = gradient.to(exposures)

    def background(self, step: int) -> Tensor | None:
        """Return the background of a step [3], or None for that of the settings."""
        return background_at(step, self._config.seed) if self._config.random_background else None

    @torch.no_grad()
    def behind_photo(self, index: int, step: int) -> Tensor | None:
        """Return what a transparent photograph is laid over at a step, in the photograph's colours [3], or None."""
        background = self.background(step)
        if background is None:
            return None
        return self.exposed(background.to(self._viewmats)[None, None], index)[0, 0]

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Move by the gradients of a step, less what the loss says nothing of, and forget the gradients."""
        rates, share = self._config.appearance_lr, step / self._config.max_steps
        for name, optimizer in self._optimizers.items():
            rate, decay = getattr(rates, name), getattr(rates, f"{name}_decay")
            optimizer.param_groups[0]["lr"] = rate * decay**share
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        if "cameras" in self.params:
            self.params["cameras"].copy_(without_common_motion(self.params["cameras"], self._viewmats))
        if "exposures" in self.params:
            self.params["exposures"].copy_(centred_exposures(self.params["exposures"]))

    def state_dict(self) -> dict[str, dict[str, Tensor]]:
        """Return everything that a resumed run needs: by name, the numbers and their moments."""
        moments = pack_optimizers(self._optimizers)
        return {name: {"value": param.detach(), **moments[name]} for name, param in self.params.items()}

    def load_state_dict(self, packed: Mapping[str, Mapping[str, Tensor]]) -> None:
        """Put back a copy of what `state_dict` returned."""
        self.params = {name: Parameter(found["value"].clone()) for name, found in packed.items()}
        self._optimizers = make_optimizers(self.params)
        for name, found in packed.items():
            moments = {key: value.clone() for key, value in found.items() if key != "value"}
            self._optimizers[name].state[self.params[name]] = moments

    def by_view(self, views: Sequence[ViewTensors]) -> dict[str, Any]:
        """Return what was learned of every photograph, by its name: `exposure` [3, 4], `viewmat` [4, 4]."""
        found: dict[str, Any] = {view.name: {} for view in views}
        for i, view in enumerate(views):
            if "exposures" in self.params:
                found[view.name]["exposure"] = self.params["exposures"][i].tolist()
            if "cameras" in self.params:
                found[view.name]["viewmat"] = self.seen_from(view, i).viewmat[0].tolist()
        return found


class _Refined(Sequence[ViewTensors]):
    """Training views, each with its camera of the moment."""

    def __init__(self, appearance: Appearance, views: Sequence[ViewTensors]) -> None:
        self._appearance, self._views = appearance, views

    def __len__(self) -> int:
        return len(self._views)

    @torch.no_grad()
    def __getitem__(self, index: Any) -> Any:
        return self._appearance.seen_from(self._views[index], range(len(self))[index])
