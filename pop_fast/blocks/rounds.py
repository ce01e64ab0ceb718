"""The rounds of a run in blocks: what a block starts from, the views that it draws, and its training among the others.

A block starts from the merged Gaussians of its core, which are trained, and those of other cores that its views see,
which are held fixed. Which Gaussians a view sees is computed once, by projecting every Gaussian into the block's views:
those that no view shows take no part in any of the round's renders, and are not held in memory. Merged Gaussians are
read one core at a time.

A block's own views are those that see most of its core. Others show it too, behind or next to what they look at, and
how it looks from there no training has corrected. So each round draws other views among all that show the core, and
holds no more photographs than the block's own training did. The cameras of all views are those of all blocks' lists,
because every training view stands in one core; the capture's own list is not read again.

An engine moves all rows. What it did to those that are held fixed is undone before the next step (`HoldingStepper`).
So every step draws the very bits that were given, and their moments, which say how a row would be moved, move nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from pop_fast.blocks.jobs import block_folder, core_of, marker_of
from pop_fast.blocks.plan import read_plan
from pop_fast.data.capture import Capture, View
from pop_fast.data.load import find_block, in_picture, load_capture, read_block, write_block
from pop_fast.density.protocol import State
from pop_fast.errors import PopError
from pop_fast.io.atomic import write_json
from pop_fast.io.read_back import read_json
from pop_fast.stages.covariance import opacities_from_logits, scales_from_log_scales
from pop_fast.stages.splatting import ProjectionSettings, covariances, project
from pop_fast.train.checkpoint import load_splats
from pop_fast.train.config import TrainConfig
from pop_fast.train.engines import engine_of
from pop_fast.train.environment import keep_freed_memory
from pop_fast.train.load_result import CaptureRecord, how_to_load
from pop_fast.train.model import KEYS
from pop_fast.train.stepper import Engine, Stepper
from pop_fast.train.steps import Phase, StepStats
from pop_fast.train.training_run import TrainingRun

# Gaussians that are projected at a time: some 20 MB
_AT_A_TIME = 65_536
_COUNTS = "start.json"


@dataclass(frozen=True)
class Start:
    """What a block starts from."""

    params: dict[str, Tensor]  # raw parameters: first those that are trained, then those that are held fixed
    own: int  # how many are trained
    merged: int  # how many Gaussians there are in all cores

    @property
    def fixed(self) -> dict[str, Tensor]:
        """Return a copy of the rows that are held fixed."""
        return {key: value[self.own :].clone() for key, value in self.params.items()}


def check_merged(folder: Path, number: int) -> list[str]:
    """Return the names of the blocks of a run in which a round can begin.

    Raises:
        PopError: the capture is not divided, or the blocks of the round before are not merged.
    """
    plan, before = read_plan(folder), number - 1
    if plan is None:
        raise PopError(f"{folder}: its capture is not divided yet; run pop blocks partition {folder}")
    if not marker_of(folder, None, before).is_file():
        raise PopError(
            f"{folder}: round {number} starts from the merged blocks of round {before}, which are not there; run "
            f"pop blocks merge {folder} --round {before}"
        )
    return plan[0].names


def read_core(folder: Path, name: str, number: int) -> dict[str, Tensor]:
    """Read the merged Gaussians of a block's core that a round starts from."""
    return load_splats(core_of(folder, name, number - 1))[0]


def read_start(folder: Path, name: str, number: int, config: TrainConfig, views: Sequence[View]) -> Start:
    """Read what a block starts from in a round.

    Raises:
        PopError: the capture is not divided, or the blocks of the round before are not merged.
    """
    names, own = check_merged(folder, number), read_core(folder, name, number)
    parts, merged = [own], len(own["means"])
    for other in names:
        if other != name:
            params = read_core(folder, other, number)
            merged += len(params["means"])
            shown = shown_in(views, params, config)
            parts.append({key: value[shown] for key, value in params.items()})
    params = {key: torch.cat([part[key] for part in parts]) for key in KEYS}
    return Start(params, len(own["means"]), merged)


@torch.no_grad()
def shown_in(views: Sequence[View], params: Mapping[str, Tensor], config: TrainConfig) -> Tensor:
    """Tell which Gaussians at least one view's camera shows, behind others or not. bool [N]"""
    drawn = (config.renderer, config.antialiased)
    Ks, viewmats = ([torch.from_numpy(getattr(view, name)).float() for view in views] for name in ("K", "viewmat"))
    settings_of = [ProjectionSettings(K, view.width, view.height, *drawn) for K, view in zip(Ks, views, strict=True)]
    shown = torch.zeros(len(params["means"]), dtype=torch.bool)
    for rows in torch.arange(len(shown)).split(_AT_A_TIME):
        means, opacities = params["means"][rows], opacities_from_logits(params["opacities"][rows])
        shapes = covariances(params["quats"][rows], scales_from_log_scales(params["scales"][rows]))
        for viewmat, settings in zip(viewmats, settings_of, strict=True):
            if len(rows) == 0:
                break
            seen = (project(means, shapes, opacities, viewmat, settings).radii > 0).all(1)
            shown[rows[seen]] = True
            rows, means, shapes, opacities = rows[~seen], means[~seen], shapes[~seen], opacities[~seen]
    return shown


def write_counts(folder: Path, name: str, number: int, start: Start) -> None:
    """Write what a block starts from in a round, in numbers, as `own_of` reads them."""
    seen = len(start.params["means"])
    counts = {"own": start.own, "fixed": seen - start.own, "merged": start.merged}
    write_json(block_folder(folder, name, number) / _COUNTS, counts, indent=None)


def own_of(folder: Path, name: str, number: int) -> dict[str, int]:
    """Read how many Gaussians a block trained in a round (`own`), held fixed (`fixed`), and how many there were.

    Raises:
        PopError: the block has not begun the round, or the file is damaged.
    """
    path = block_folder(folder, name, number) / _COUNTS
    fix = f"run pop blocks train {folder} {name} --round {number}"
    if not path.is_file():
        raise PopError(f"{path}: is absent; {fix}")
    found = read_json(path, fix)
    if not isinstance(found, dict) or any(type(found.get(key)) is not int for key in ("own", "fixed", "merged")):
        raise PopError(f"{path}: is not what 'pop blocks train' writes; {fix}")
    return found


def prepare(
    config: TrainConfig,
    capture: Capture,
    start: Start,
    *,
    resume: bool = False,
    loading_seconds: float = 0.0,
    beside: Mapping[str, str] | None = None,
) -> TrainingRun:
    """Prepare the training of a block in a round.

    Args:
        resume: continue from the latest checkpoint of `config.result_dir`, or start where there is none.
        beside: texts to write next to cfg.json, by file name.
    """
    keep_freed_memory()
    engine = hold_last(engine_of(config), start.fixed)
    how = {"resume": resume, "loading_seconds": loading_seconds, "beside": beside}
    return TrainingRun(config, capture, initial=start.params, engine=engine, **how)


# of the Gaussians of a core, what a view must have in its picture to be drawn: fewer are strays
_SHOWN = 0.01


def write_round_block(
    folder: Path, config: TrainConfig, record: CaptureRecord, names: list[str], name: str, number: int, core: np.ndarray
) -> None:
    """Draw the views of a block for a round and write their list, unless that is there already.

    Args:
        core: centres of the Gaussians in its core, in the training frame. [N, 3]

    Raises:
        CaptureError: a block's list is damaged.
    """
    place = block_folder(folder, name, number)
    if find_block(place):
        return
    listings = {other: read_block(block_folder(folder, other)) for other in names}
    own = listings[name]
    shots = {shot.name: shot for each in listings.values() for shot in each.shots if shot.split == "train"}
    every = replace(own, shots=list(shots.values()))
    given = how_to_load(config, record)
    cameras = load_capture(block_folder(folder, name), **given, photographs="none", listing=every)
    points = core.astype(np.float64)
    showing = [view.name for view in cameras.views if in_picture(points, view).mean() >= _SHOWN] if len(core) else []
    had = [shot for shot in own.shots if shot.split == "train"]
    draw = np.random.default_rng([config.seed, number, names.index(name)])
    drawn = draw.permutation(len(showing))[: len(had)]
    chosen, out = [shots[showing[index]] for index in sorted(drawn)], [s for s in own.shots if s.split == "test"]
    # a capture of one view is none
    enough = chosen and len(chosen) + len(out) > 1
    write_block(place, replace(own, shots=[*(chosen if enough else had), *out]))


def hold_last(engine: Engine, rows: Mapping[str, Tensor]) -> Engine:
    """Return an engine that keeps the last rows of the parameters as they are.

    Args:
        rows: raw parameters of these Gaussians, which the parameters of the run must end with; they are not copied.
            The run's strategy must not change the number of Gaussians.
    """
    return replace(engine, make_stepper=lambda task: HoldingStepper(engine.make_stepper(task), rows))


class HoldingStepper:
    """Takes steps by another stepper, one at a time, and puts fixed rows back after each; see `Stepper`.

    Args:
        rows: raw parameters of the Gaussians that are held, the last ones of those that are trained.
    """

    def __init__(self, stepper: Stepper, rows: Mapping[str, Tensor]) -> None:
        self.name, self.step = stepper.name, stepper.step
        self._stepper, self._rows = stepper, dict(rows)
        self._places: dict[str, Tensor] = {}

    @property
    def longest(self) -> int:
        return self._stepper.longest

    def rebind(self, params: dict[str, Parameter], optimizers: Mapping[str, Adam], state: State) -> None:
        """See `Stepper.rebind`.

        Raises:
            PopError: the parameters do not end with the rows that are held.
        """
        self._places = {key: params[key].detach()[len(params[key]) - len(self._rows[key]) :] for key in self._rows}
        self._rows = {key: rows.to(self._places[key].device) for key, rows in self._rows.items()}
        for key, place in self._places.items():
            if not torch.equal(place, self._rows[key]):
                raise PopError(
                    f"{key} of the Gaussians that are held fixed are others than this training was begun with; remove "
                    "its result folder and start it again"
                )
        self._stepper.rebind(params, optimizers, state)

    def steps(self, first: int, last: int, phase: Phase) -> list[StepStats]:
        found: list[StepStats] = []
        for step in range(first, last):
            try:
                found += self._stepper.steps(step, step + 1, phase)
            finally:
                self.step = self._stepper.step
            if self.step == step:
                break
            for key, place in self._places.items():
                place.copy_(self._rows[key])
        return found

    def synchronize(self) -> None:
        self._stepper.synchronize()

    def gather(self, everywhere: bool = False) -> None:
        self._stepper.gather(everywhere)

    def moments(self) -> dict[str, dict[str, Tensor]]:
        return self._stepper.moments()

    def facts(self) -> dict[str, Any]:
        """See `Stepper.facts`; `fixed_gaussians` says how many are held."""
        return {**self._stepper.facts(), "fixed_gaussians": len(self._rows["means"])}
