"""Ways to damage a capture, checkpoints that no run can have written, and what a clean refusal looks like."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from pop_fast.train import checkpoint as ckpt
from tests.app.conftest import Outcome

Damage = Callable[[Path], None]


def says(outcome: Outcome, *parts: str) -> None:
    """Assert that the outcome is one clean line of error with all of these parts."""
    assert outcome.status == 2, outcome
    lines = outcome.err.strip().splitlines()
    assert len(lines) == 1, outcome.err
    assert lines[0].startswith("pop: error: ")
    for part in parts:
        assert part in lines[0], (part, lines[0])


def photo(folder: Path, number: int = 0) -> Path:
    return folder / "images" / f"view_{number:03d}.png"


def truncate(path: Path, share: float = 0.5) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def contents(folder: Path) -> dict[Path, bytes]:
    """Read every file under a folder, to see that nothing changed."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


Content = dict[str, Any]


def latest(folder: Path) -> Path:
    return ckpt.checkpoint_path(folder, 9)


def place(content: Content, where: str) -> tuple[Any, str]:
    *outer, key = where.split(".")
    for name in outer:
        content = content[name]
    return content, key


def to(where: str, value: Any) -> Callable[[Content], Any]:
    """Put a value, or what a function makes of the value that is there, under a name like `splats.means`."""

    def change(content: Content) -> None:
        inside, key = place(content, where)
        inside[key] = value(inside[key]) if callable(value) else value

    return change


def without(where: str) -> Callable[[Content], Any]:
    def change(content: Content) -> None:
        inside, key = place(content, where)
        del inside[key]

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
FORGED: dict[str, tuple[Callable[[Content], Any], tuple[str, ...]]] = {
    # moments: what torch's fused Adam takes on trust
    "m of another shape": (to(f"{MEANS}.exp_avg", torch.zeros(3, 3)), (f"{MEANS}.exp_avg has shape [3, 3]",)),
    "m of another rank": (to(f"{MEANS}.exp_avg", lambda m: m.reshape(-1)), (f"{MEANS}.exp_avg has shape",)),
    "m empty": (to("optimizers.shN.exp_avg", torch.zeros(0)), ("optimizers.shN.exp_avg has shape [0]",)),
    "v of another shape": (
        to(f"{MEANS}.exp_avg_sq", lambda v: v[:1].clone()),
        (f"{MEANS}.exp_avg_sq has shape [1, 3]",),
    ),
    "m in double": (to(f"{MEANS}.exp_avg", lambda m: m.double()), (f"{MEANS}.exp_avg is torch.float64", "float32")),
    "v in half": (to(f"{MEANS}.exp_avg_sq", lambda v: v.half()), (f"{MEANS}.exp_avg_sq is torch.float16",)),
    "m a list": (to(f"{MEANS}.exp_avg", [0.0]), (f"{MEANS}.exp_avg is list", "a tensor of float32")),
    "m sparse": (to(f"{MEANS}.exp_avg", lambda m: m.to_sparse()), (f"{MEANS}.exp_avg is not a plain array",)),
    "m one number": (to(f"{MEANS}.exp_avg", lambda m: torch.zeros(1).expand(m.shape)), ("of which the file holds 4",)),
    "m is v": (shared_moments, (f"{MEANS}.exp_avg_sq and {MEANS}.exp_avg are the same memory",)),
    "m NaN": (to("optimizers.scales.exp_avg", entry(NAN)), ("optimizers.scales.exp_avg[0, 1] is nan", "finite")),
    "m infinite": (to("optimizers.sh0.exp_avg", entry(INF)), ("optimizers.sh0.exp_avg[0, 0, 1] is inf",)),
    "v NaN": (to("optimizers.sh0.exp_avg_sq", entry(NAN)), ("optimizers.sh0.exp_avg_sq[0, 0, 1] is nan",)),
    "v negative": (
        to("optimizers.opacities.exp_avg_sq", entry(-1.0)),
        ("opacities.exp_avg_sq[1] is -1.0", "at least 0"),
    ),
    "step of moments a row": (to(STEP, torch.full((1,), 10.0)), (f"{STEP} has shape [1]; it must be []",)),
    "step of moments whole": (to(STEP, torch.tensor(10)), (f"{STEP} is torch.int64",)),
    "step of moments no tensor": (to(STEP, 10), (f"{STEP} is 10; it must be a tensor",)),
    "step of moments negative": (
        to(STEP, torch.tensor(-10.0)),
        (f"{STEP} is -10; it must be a whole number of updates, at most 10",),
    ),
    "step of moments NaN": (
        to(STEP, torch.tensor(NAN)),
        (f"{STEP} is nan; it must be a whole number of updates, at most 10",),
    ),
    "step of moments of another run": (
        to(STEP, torch.tensor(11.0)),
        (f"{STEP} is 11; it must be a whole number of updates, at most 10",),
    ),
    "no moments of means": (without(MEANS), ("has no optimizers.means",)),
    "no m": (without(f"{MEANS}.exp_avg"), (f"has no {MEANS}.exp_avg",)),
    "a moment too many": (to(f"{MEANS}.max_exp_avg_sq", 0), (f"{MEANS}.'max_exp_avg_sq' is unknown",)),
    "a parameter's moments too many": (to("optimizers.colour", {}), ("optimizers.'colour' is unknown",)),
    "moments a list": (to("optimizers", []), ("optimizers is list; it must be a dict",)),
    "moments of one a tensor": (to(MEANS, torch.zeros(3)), (f"{MEANS} is Tensor; it must be a dict",)),
    # parameters
    "a parameter of another shape": (to("splats.quats", lambda q: q[:, :3].clone()), ("splats.quats has shape",)),
    "fewer rows than moments": (fewer_rows, ("optimizers.means.exp_avg has shape",)),
    "fewer colours": (to("splats.shN", lambda s: s[:, :8].clone()), ("splats.shN has shape",)),
    "no parameter": (without("splats.sh0"), ("has no splats.sh0",)),
    "a parameter in double": (to("splats.means", lambda m: m.double()), ("splats.means is torch.float64",)),
    "a parameter in whole numbers": (to("splats.means", lambda m: m.int()), ("splats.means is torch.int32",)),
    "a parameter NaN": (to("splats.opacities", entry(NAN)), ("splats.opacities[1] is nan",)),
    "a scale beyond all floats": (to("splats.scales", entry(1000.0)), ("splats.scales[0, 1] is inf",)),
    "a billion rows of one number": (
        to("splats.means", torch.zeros(1).expand(10**9, 3)),
        ("splats.means has 12000000000 bytes, of which the file holds 4",),
    ),
    "a scalar": (to("splats.means", torch.tensor(0.0)), ("splats.means has shape []; it must be [N, 3]",)),
    "a sparse parameter": (to("splats.means", lambda m: m.to_sparse()), ("splats.means is not a plain array",)),
    "a parameter without memory": (to("splats.means", lambda m: m.to("meta")), ("splats.means is not a plain array",)),
    "parameters a list": (to("splats", [1]), ("splats is list",)),
    # the strategy's state
    "no strategy's state": (to("strategy", {}), ("has no strategy.generator",)),
    "no random numbers": (without("strategy.generator"), ("has no strategy.generator",)),
    "no blur": (without("strategy.blurred"), ("strategy.blurred is missing",)),
    "a state of other strategies": (to("strategy.momentum", None), ("strategy.momentum is unknown",)),
    "sums of more rows": (to("strategy.grad2d", lambda g: torch.cat([g, g])), ("strategy.grad2d has shape",)),
    "sums of one row": (to("strategy.count", torch.ones(1)), ("strategy.count has shape [1]",)),
    "sums in double": (to("strategy.grad2d", lambda g: g.double()), ("strategy.grad2d is torch.float64",)),
    "sums NaN": (to("strategy.grad2d", entry(NAN)), ("strategy.grad2d[1] is nan",)),
    "counts negative": (to("strategy.count", entry(-1.0)), ("strategy.count[1] is -1.0",)),
    "sums without counts": (to("strategy.count", None), ("strategy.grad2d and strategy.count",)),
    "blur in whole numbers": (to("strategy.blurred", lambda b: b.int()), ("strategy.blurred is torch.int32",)),
    "blur neither true nor false": (to("strategy.blurred", garbage_bools), ("strategy.blurred holds what is neither",)),
    "pixels in floats": (to("strategy.dominant_sum", torch.zeros(3)), ("strategy.dominant_sum is torch.float32",)),
    "views negative": (to("strategy.views", -1), ("strategy.views is -1", "from 0 to 10")),
    "views of the future": (to("strategy.views", 11), ("strategy.views is 11",)),
    "views beyond all": (to("strategy.views", 10**100), ("strategy.views is a number beyond 2^63",)),
    "views true": (to("strategy.views", True), ("strategy.views is True",)),
    "a scene of no size": (to("strategy.scene_scale", NAN), ("strategy.scene_scale is nan",)),
    "a scene's size in words": (to("strategy.scene_scale", "1"), ("strategy.scene_scale is '1'",)),
    "more in a strategy's state": (to("strategy.more", [1]), ("strategy.more is list",)),
    "random numbers too short": (
        to("strategy.generator", torch.zeros(7, dtype=torch.uint8)),
        ("generator has shape [7]",),
    ),
    "random numbers of zeros": (to("strategy.generator", torch.zeros_like), ("strategy.generator is not the state",)),
    "random numbers of ones": (
        to("strategy.generator", lambda g: torch.full_like(g, 255)),
        ("strategy.generator is not",),
    ),
    "random numbers in floats": (to("strategy.generator", torch.zeros(3)), ("strategy.generator is torch.float32",)),
    # the order of views
    "a view twice": (to("view_order.order", [0, 1, 1, 3]), ("view_order.order must hold every view once",)),
    "a view that is not there": (
        to("view_order.order", [0, 1, 2, 3, 4]),
        ("view_order.order has 5 views; it must have 4",),
    ),
    "a view negative": (to("view_order.order", [-1, 0, 1, 2]), ("view_order.order must hold",)),
    "a view in words": (to("view_order.order", ["0"]), ("view_order.order is list; it must be a list of whole",)),
    "views a tensor": (to("view_order.order", torch.arange(4)), ("view_order.order is Tensor",)),
    "a place negative": (to("view_order.position", -1), ("view_order.position is -1; it must be", "from 0 to 4")),
    "a place behind the end": (to("view_order.position", 5), ("view_order.position is 5",)),
    "an order without a place": (without("view_order.position"), ("has no view_order.position",)),
    "an order's random numbers": (to("view_order.generator", None), ("view_order.generator is None",)),
    "no order": (to("view_order", None), ("view_order is None; it must be a dict",)),
    # the rest
    "step negative": (to("step", -1), ("step is -1; it must be a whole number, at least 0",)),
    "step in words": (to("step", "9"), ("step is '9'",)),
    "step a tensor": (to("step", torch.tensor(9)), ("step is Tensor",)),
    "step beyond all": (to("step", 10**30), ("step is a number beyond 2^63",)),
    "settings a list": (to("config", []), ("config is list",)),
    "settings with a tensor": (
        to("config.seed", torch.zeros(2)),
        ("config.'seed' is Tensor; it must be a plain value",),
    ),
    "settings with a number for a name": (lambda c: c["config"].update({1: 2}), ("config.1 is 2",)),
    "a capture a text": (to("capture", "fox"), ("capture is 'fox'",)),
    "a capture with a tensor": (to("capture.masks", torch.zeros(2)), ("capture.'masks' is Tensor; it must be a text",)),
    "metrics negative": (to("metrics_bytes", -1), ("metrics_bytes is -1",)),
    "metrics in halves": (to("metrics_bytes", 1.5), ("metrics_bytes is 1.5",)),
    "metrics beyond the file": (to("metrics_bytes", 2**40), ("metrics.jsonl: has",)),
    "no seconds": (without("seconds.total"), ("has no seconds.total",)),
    "seconds NaN": (to("seconds.train", NAN), ("seconds.train is nan",)),
    "seconds in words": (to("seconds.train", "1"), ("seconds.train is '1'",)),
    "no threads": (to("threads", 0), ("threads is 0; it must be a whole number, at least 1",)),
    "a format in words": (to("format", "1" * 1000), ("has format '111", "this version reads format 1")),
    "no format": (without("format"), ("has no 'format'",)),
}


def forge(folder: Path, change: Callable[[Content], Any]) -> None:
    """Change the latest checkpoint's content in place."""
    content = torch.load(latest(folder), weights_only=True)
    change(content)
    torch.save(content, latest(folder))
