"""Ways to damage a capture, checkpoints that no run can have written, and what a clean refusal looks like."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from pop_fast.train import checkpoint as ckpt
from tests.app.conftest import Outcome


def says(outcome: Outcome, *parts: str) -> None:
    """Assert that the outcome is one clean line of error with all of these parts."""
    assert outcome.status == 2, outcome
    lines = outcome.err.strip().splitlines()
    assert len(lines) == 1, outcome.err
    assert lines[0].startswith("pop: error: ")
    for part in parts:
        assert part in lines[0], (part, lines[0])


def truncate(path: Path, share: float = 0.5) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def contents(folder: Path) -> dict[Path, bytes]:
    """Read every file under a folder, to see that nothing changed."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


Content = dict[str, Any]
# stands for a name that is left out
GONE = object()


def latest(folder: Path) -> Path:
    return ckpt.checkpoint_path(folder, 9)


def to(where: str, value: Any) -> Callable[[Content], Any]:
    """Put a value, or what a function makes of the value that is there, under a name like `splats.means`."""

    def change(content: Content) -> None:
        *outer, key = where.split(".")
        for name in outer:
            content = content[name]
        content[key] = value(content[key]) if callable(value) else value
        if value is GONE:
            del content[key]

    return change


def entry(value: float) -> Callable[[torch.Tensor], torch.Tensor]:
    """Change the second number of a tensor."""

    def change(tensor: torch.Tensor) -> torch.Tensor:
        changed = tensor.clone()
        changed.view(-1)[1] = value
        return changed

    return change


def garbage_bools(tensor: torch.Tensor) -> torch.Tensor:
    return torch.full((len(tensor),), 77, dtype=torch.uint8).view(torch.bool)


def shared_moments(content: Content) -> None:
    moments = content["optimizers"]["means"]
    moments["exp_avg"] = moments["exp_avg_sq"]


def fewer_rows(content: Content) -> None:
    content["splats"] = {key: value[:-1].clone() for key, value in content["splats"].items()}


NAN, INF = float("nan"), float("inf")
MEANS, STEP = "optimizers.means", "optimizers.quats.step"
M, V = f"{MEANS}.exp_avg", f"{MEANS}.exp_avg_sq"
UPDATES = "it must be a whole number of updates, at most 10"


def forged(where: str, value: Any, *parts: str) -> tuple[Callable[[Content], Any], tuple[str, ...]]:
    """What is put where, and the parts of what is said of it."""
    return to(where, value), parts


FORGED: dict[str, tuple[Callable[[Content], Any], tuple[str, ...]]] = {
    # moments: what torch's fused Adam takes on trust
    "m of another shape": forged(M, torch.zeros(3, 3), f"{M} has shape [3, 3]"),
    "m of another rank": forged(M, lambda m: m.reshape(-1), f"{M} has shape"),
    "m empty": forged("optimizers.shN.exp_avg", torch.zeros(0), "optimizers.shN.exp_avg has shape [0]"),
    "v of another shape": forged(V, lambda v: v[:1].clone(), f"{V} has shape [1, 3]"),
    "m in double": forged(M, lambda m: m.double(), f"{M} is torch.float64", "float32"),
    "v in half": forged(V, lambda v: v.half(), f"{V} is torch.float16"),
    "m a list": forged(M, [0.0], f"{M} is list", "a tensor of float32"),
    "m sparse": forged(M, lambda m: m.to_sparse(), f"{M} is not a plain array"),
    "m one number": forged(M, lambda m: torch.zeros(1).expand(m.shape), "of which the file holds 4"),
    "m is v": (shared_moments, (f"{V} and {M} are the same memory",)),
    "m NaN": forged("optimizers.scales.exp_avg", entry(NAN), "optimizers.scales.exp_avg[0, 1] is nan", "finite"),
    "m infinite": forged("optimizers.sh0.exp_avg", entry(INF), "optimizers.sh0.exp_avg[0, 0, 1] is inf"),
    "v NaN": forged("optimizers.sh0.exp_avg_sq", entry(NAN), "optimizers.sh0.exp_avg_sq[0, 0, 1] is nan"),
    "v negative": forged(
        "optimizers.opacities.exp_avg_sq", entry(-1.0), "opacities.exp_avg_sq[1] is -1.0", "at least 0"
    ),
    "step of moments a row": forged(STEP, torch.full((1,), 10.0), f"{STEP} has shape [1]; it must be []"),
    "step of moments whole": forged(STEP, torch.tensor(10), f"{STEP} is torch.int64"),
    "step of moments no tensor": forged(STEP, 10, f"{STEP} is 10; it must be a tensor"),
    "step of moments negative": forged(STEP, torch.tensor(-10.0), f"{STEP} is -10; {UPDATES}"),
    "step of moments NaN": forged(STEP, torch.tensor(NAN), f"{STEP} is nan; {UPDATES}"),
    "step of moments of another run": forged(STEP, torch.tensor(11.0), f"{STEP} is 11; {UPDATES}"),
    "no moments of means": forged(MEANS, GONE, "has no optimizers.means"),
    "no m": forged(M, GONE, f"has no {M}"),
    "a moment too many": forged(f"{MEANS}.max_exp_avg_sq", 0, f"{MEANS}.'max_exp_avg_sq' is unknown"),
    "a parameter's moments too many": forged("optimizers.colour", {}, "optimizers.'colour' is unknown"),
    "moments a list": forged("optimizers", [], "optimizers is list; it must be a dict"),
    "moments of one a tensor": forged(MEANS, torch.zeros(3), f"{MEANS} is Tensor; it must be a dict"),
    # parameters
    "a parameter of another shape": forged("splats.quats", lambda q: q[:, :3].clone(), "splats.quats has shape"),
    "fewer rows than moments": (fewer_rows, ("optimizers.means.exp_avg has shape",)),
    "fewer colours": forged("splats.shN", lambda s: s[:, :8].clone(), "splats.shN has shape"),
    "no parameter": forged("splats.sh0", GONE, "has no splats.sh0"),
    "a parameter in double": forged("splats.means", lambda m: m.double(), "splats.means is torch.float64"),
    "a parameter in whole numbers": forged("splats.means", lambda m: m.int(), "splats.means is torch.int32"),
    "a parameter NaN": forged("splats.opacities", entry(NAN), "splats.opacities[1] is nan"),
    "a scale beyond all floats": forged("splats.scales", entry(1000.0), "splats.scales[0, 1] is inf"),
    "a billion rows of one number": forged(
        "splats.means", torch.zeros(1).expand(10**9, 3), "splats.means has 12000000000 bytes, of which the file holds 4"
    ),
    "a scalar": forged("splats.means", torch.tensor(0.0), "splats.means has shape []; it must be [N, 3]"),
    "a sparse parameter": forged("splats.means", lambda m: m.to_sparse(), "splats.means is not a plain array"),
    "a parameter without memory": forged("splats.means", lambda m: m.to("meta"), "splats.means is not a plain array"),
    "parameters a list": forged("splats", [1], "splats is list"),
    # the strategy's state
    "no strategy's state": forged("strategy", {}, "has no strategy.generator"),
    "no random numbers": forged("strategy.generator", GONE, "has no strategy.generator"),
    "no blur": forged("strategy.blurred", GONE, "strategy.blurred is missing"),
    "a state of other strategies": forged("strategy.momentum", None, "strategy.momentum is unknown"),
    "sums of more rows": forged("strategy.grad2d", lambda g: torch.cat([g, g]), "strategy.grad2d has shape"),
    "sums of one row": forged("strategy.count", torch.ones(1), "strategy.count has shape [1]"),
    "sums in double": forged("strategy.grad2d", lambda g: g.double(), "strategy.grad2d is torch.float64"),
    "sums NaN": forged("strategy.grad2d", entry(NAN), "strategy.grad2d[1] is nan"),
    "counts negative": forged("strategy.count", entry(-1.0), "strategy.count[1] is -1.0"),
    "sums without counts": forged("strategy.count", None, "strategy.grad2d and strategy.count"),
    "blur in whole numbers": forged("strategy.blurred", lambda b: b.int(), "strategy.blurred is torch.int32"),
    "blur neither true nor false": forged("strategy.blurred", garbage_bools, "strategy.blurred holds what is neither"),
    "pixels in floats": forged("strategy.dominant_sum", torch.zeros(3), "strategy.dominant_sum is torch.float32"),
    "views negative": forged("strategy.views", -1, "strategy.views is -1", "from 0 to 10"),
    "views of the future": forged("strategy.views", 11, "strategy.views is 11"),
    "views beyond all": forged("strategy.views", 10**100, "strategy.views is a number beyond 2^63"),
    "views true": forged("strategy.views", True, "strategy.views is True"),
    "a scene of no size": forged("strategy.scene_scale", NAN, "strategy.scene_scale is nan"),
    "a scene's size in words": forged("strategy.scene_scale", "1", "strategy.scene_scale is '1'"),
    "a first count in words": forged("strategy.first_count", "1", "strategy.first_count is '1'"),
    "more in a strategy's state": forged("strategy.more", [1], "strategy.more is list"),
    "random numbers too short": forged(
        "strategy.generator", torch.zeros(7, dtype=torch.uint8), "generator has shape [7]"
    ),
    "random numbers of zeros": forged("strategy.generator", torch.zeros_like, "strategy.generator is not the state"),
    "random numbers of ones": forged(
        "strategy.generator", lambda g: torch.full_like(g, 255), "strategy.generator is not"
    ),
    "random numbers in floats": forged("strategy.generator", torch.zeros(3), "strategy.generator is torch.float32"),
    # the order of views
    "a view twice": forged("view_order.order", [0, 1, 1, 3], "view_order.order must hold every view once"),
    "a view that is not there": forged(
        "view_order.order", [0, 1, 2, 3, 4], "view_order.order has 5 views; it must have 4"
    ),
    "a view negative": forged("view_order.order", [-1, 0, 1, 2], "view_order.order must hold"),
    "a view in words": forged("view_order.order", ["0"], "view_order.order is list; it must be a list of whole"),
    "views a tensor": forged("view_order.order", torch.arange(4), "view_order.order is Tensor"),
    "a place negative": forged("view_order.position", -1, "view_order.position is -1; it must be", "from 0 to 4"),
    "a place behind the end": forged("view_order.position", 5, "view_order.position is 5"),
    "an order without a place": forged("view_order.position", GONE, "has no view_order.position"),
    "an order's random numbers": forged("view_order.generator", None, "view_order.generator is None"),
    "no order": forged("view_order", None, "view_order is None; it must be a dict"),
    # the rest
    "step negative": forged("step", -1, "step is -1; it must be a whole number, at least 0"),
    "step in words": forged("step", "9", "step is '9'"),
    "step a tensor": forged("step", torch.tensor(9), "step is Tensor"),
    "step beyond all": forged("step", 10**30, "step is a number beyond 2^63"),
    "settings a list": forged("config", [], "config is list"),
    "settings with a tensor": forged(
        "config.seed", torch.zeros(2), "config.'seed' is Tensor; it must be a plain value"
    ),
    "settings with a number for a name": (lambda c: c["config"].update({1: 2}), ("config.1 is 2",)),
    "a capture a text": forged("capture", "fox", "capture is 'fox'"),
    "a capture with a tensor": forged("capture.masks", torch.zeros(2), "capture.'masks' is Tensor; it must be a text"),
    "metrics negative": forged("metrics_bytes", -1, "metrics_bytes is -1"),
    "metrics in halves": forged("metrics_bytes", 1.5, "metrics_bytes is 1.5"),
    "metrics beyond the file": forged("metrics_bytes", 2**40, "metrics.jsonl: has", "bytes, fewer than"),
    "no seconds": forged("seconds.total", GONE, "has no seconds.total"),
    "seconds NaN": forged("seconds.train", NAN, "seconds.train is nan"),
    "seconds in words": forged("seconds.train", "1", "seconds.train is '1'"),
    "no threads": forged("threads", 0, "threads is 0; it must be a whole number, at least 1"),
    "a format in words": forged("format", "1" * 1000, "has format '111", "this version reads format 1"),
    "a newer format": forged("format", 99, "has format 99; this version reads format 1"),
    "no format": forged("format", GONE, "has no 'format'"),
}


def forge(folder: Path, change: Callable[[Content], Any]) -> None:
    """Change the latest checkpoint's content in place."""
    content = torch.load(latest(folder), weights_only=True)
    change(content)
    torch.save(content, latest(folder))
