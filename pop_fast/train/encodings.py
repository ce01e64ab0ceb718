"""What a splat weighs in every file format, and how well it shows the held-out views when it comes back from one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from torch import Tensor

from pop_fast.data import apply_similarity, to_capture_frame
from pop_fast.errors import PopError
from pop_fast.io.formats import decoded, encoded, format_names
from pop_fast.train.config import TrainConfig
from pop_fast.train.evaluate import evaluate
from pop_fast.train.views import ViewTensors, evenly

# held-out views that are rendered for every format, at most; of more, an even selection
_MOST_VIEWS: Final = 4


@dataclass(frozen=True)
class Encoding:
    """A splat in a format.

    Attributes:
        format: its name.
        bytes: of the file.
        num_gaussians: in it.
        psnr: mean over some held-out views after a round trip, dB; None where there is none.
        views: how many these are.
    """

    format: str
    bytes: int
    num_gaussians: int
    psnr: float | None
    views: int

    def entry(self) -> dict[str, Any]:
        """Return what the statistics hold of it."""
        return asdict(self)


def measure_encodings(
    backend: Any,
    params: Mapping[str, Tensor],
    views: Sequence[ViewTensors],
    config: TrainConfig,
    sh_degree: int,
    world_transform: np.ndarray,
    names: Sequence[str] | None = None,
) -> Iterator[Encoding]:
    """Write a splat in every format, in the capture's own frame, read it back and measure it in the training frame.

    A format that cannot hold the splat is left out.

    Args:
        backend: what renders.
        params: raw parameters, in the training frame.
        views: held-out views.
        config: background, profile and antialiasing are read.
        sh_degree: highest active colour band.
        world_transform: the training frame from the capture's. [4, 4]
        names: of the formats; None takes all.

    Yields:
        One format after the other, as soon as it is measured.
    """
    some = evenly(views, _MOST_VIEWS)
    plain = {name: value.detach().cpu() for name, value in params.items()}
    own = to_capture_frame(plain, world_transform)
    for name in format_names() if names is None else names:
        try:
            data = encoded(name, own, config.antialiased)
        except PopError:
            continue
        back = apply_similarity(decoded(name, data)[0], world_transform)
        psnr = evaluate(backend, back, some, config, sh_degree)["psnr"] if some else None
        yield Encoding(name, len(data), len(own["means"]), psnr, len(some))
