"""Record what the scrubber plays: two trainings of the toy of `pop_ref.learn.splat`, without and with the prior.

    python -m pop_ref.walkthrough.widgets.record      # two minutes or so; rewrites scrubber.json

Both start from the same Gaussians and see the same photographs in the same order. A frame holds the render of a view
that no step has seen, its PSNR, the number of Gaussians and a histogram of their opacities.
"""

from __future__ import annotations

import base64
import json
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_ref.learn import splat

FILE: Final = Path(__file__).with_name("scrubber.json")

N_STEPS: Final = 500
SIZE: Final = 64
N_VIEWS: Final = 24
N_START: Final = 300
N_BINS: Final = 20
LAMBDAS: Final = {"without": 0.0, "with": 1e-2}
FRAMES: Final = (
    0,
    5,
    10,
    15,
    20,
    30,
    40,
    50,
    65,
    80,
    100,
    120,
    150,
    180,
    210,
    250,
    300,
    350,
    400,
    450,
    500,
)
LEARNING_RATES: Final = {
    "means": 4e-3,
    "quats": 1e-2,
    "scales": 1.5e-2,
    "opacities": 5e-2,
    "sh0": 2e-2,
}
# levels a colour channel is stored with: fewer than 256 deflate to half the bytes and look the same at this size
_LEVELS: Final = 48


@dataclass(frozen=True)
class Frame:
    """One moment of a training: the unseen view [SIZE, SIZE, 3], its PSNR in dB, Gaussians, counts per opacity bin."""

    step: int
    image: np.ndarray
    psnr: float
    n: int
    opacities: tuple[int, ...]


def frames(lambda_pop: float, last_step: int = N_STEPS) -> Iterator[Frame]:
    """Train the toy with a weight of the prior and tell of the steps in `FRAMES`.

    Args:
        lambda_pop: the prior's weight, 1; 0 trains without it.
        last_step: where to end, for a look at the first frames only; the learning rates fall as over `N_STEPS`.
    """
    rng, background = np.random.default_rng(0), np.zeros(3)
    cameras = [splat.orbit(2 * np.pi * k / N_VIEWS, SIZE) for k in range(N_VIEWS)]
    photographs, unseen = (
        [splat.photograph(camera) for camera in cameras],
        splat.orbit(np.pi / N_VIEWS, SIZE),
    )
    target = splat.photograph(unseen)
    params = splat.start(N_START, rng)
    m, v = ({name: np.zeros_like(x) for name, x in params.items()} for _ in range(2))
    grad_sum, n_visible = np.zeros((2, N_START))
    for step in range(last_step + 1):
        if step in FRAMES:
            yield _frame(step, params, unseen, target)
        # views and offsets are drawn by the step's own number, so that one run's splits shift nothing in the other
        draws = np.random.default_rng((1, step))
        k = int(draws.integers(N_VIEWS))
        image, s = splat.render(params, cameras[k], background)
        _, v_image = splat.l2(image, photographs[k])
        grads, v_means2d = splat.render_vjp(params, s, v_image)
        v_opacities = lambda_pop * splat.pop_loss_vjp(s.opacities, s.dominant_counts)
        grads["opacities"] += s.opacities * (1 - s.opacities) * v_opacities
        rates = {
            name: rate * 0.1 ** ((step + 1) / N_STEPS)
            for name, rate in LEARNING_RATES.items()
        }
        splat.adam_step(params, grads, m, v, step + 1, rates)
        grad_sum += s.visible * np.linalg.norm(SIZE / 2 * v_means2d, axis=1)
        n_visible += s.visible
        if (step + 1) % 100 == 0 and step < N_STEPS // 2:
            average_grads = grad_sum / np.maximum(n_visible, 1)
            offsets = _offsets(draws)
            splat.densify_and_prune(params, m, v, average_grads, 3.0, offsets)
            grad_sum, n_visible = np.zeros((2, len(params["means"])))


def recording() -> dict[str, Any]:
    """Train twice and pack the frames: the pictures as one PNG in base64, a column a step, the photograph
    in the last, and a row a run."""
    runs = {name: list(frames(weight)) for name, weight in LAMBDAS.items()}
    target = splat.photograph(splat.orbit(np.pi / N_VIEWS, SIZE))
    rows = [
        np.concatenate([*(frame.image for frame in run), target], axis=1)
        for run in runs.values()
    ]
    return {
        "steps": list(FRAMES),
        "size": SIZE,
        "pictures": _png(np.concatenate(rows, axis=0)),
        "runs": {
            name: {
                "lambda_pop": LAMBDAS[name],
                "psnr": [round(frame.psnr, 3) for frame in run],
                "n": [frame.n for frame in run],
                "opacities": [list(frame.opacities) for frame in run],
            }
            for name, run in runs.items()
        },
    }


def _frame(
    step: int, params: dict[str, np.ndarray], camera: Any, target: np.ndarray
) -> Frame:
    image, s = splat.render(params, camera, np.zeros(3))
    image = np.clip(image, 0.0, 1.0)
    counts, _ = np.histogram(s.opacities, bins=N_BINS, range=(0.0, 1.0))
    psnr = -10.0 * float(np.log10(splat.l2(image, target)[0]))
    return Frame(step, image, psnr, len(s.opacities), tuple(counts.tolist()))


def _offsets(draws: np.random.Generator) -> Any:
    return lambda n: draws.standard_normal((2, n, 3))


def _png(image: np.ndarray) -> str:
    rows = (
        np.floor(np.clip(image, 0, 1) * (_LEVELS - 1) + 0.5) * 255 / (_LEVELS - 1) + 0.5
    ).astype(np.uint8)
    # the difference to the pixel on the left deflates better than the pixel: PNG's filter 1
    left = np.concatenate([np.zeros_like(rows[:, :1]), rows[:, :-1]], axis=1)
    raw = b"".join(b"\1" + row.tobytes() for row in rows - left)
    told = b"\x89PNG\r\n\x1a\n"
    header = struct.pack(">IIBBBBB", rows.shape[1], rows.shape[0], 8, 2, 0, 0, 0)
    for kind, data in ((b"IHDR", header), (b"IDAT", zlib.compress(raw, 9)), (b"IEND", b"")):
        told += (
            struct.pack(">I", len(data))
            + kind
            + data
            + struct.pack(">I", zlib.crc32(kind + data))
        )
    return base64.b64encode(told).decode("ascii")


def main() -> None:
    """Rewrite the recording beside this file."""
    FILE.write_text(json.dumps(recording(), separators=(",", ":")) + "\n", encoding="utf-8")
    print(f"{FILE.name}: {FILE.stat().st_size} bytes")


if __name__ == "__main__":
    main()
