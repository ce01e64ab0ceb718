"""What a block starts from in a round: the merged Gaussians of its core, and those of other cores that its views see.

The first are trained, the others held fixed. Who sees what is found once, by projecting every Gaussian into the
block's views: those that no view shows take no part in any of the round's renders, and are not held in memory. Merged
Gaussians are read one core at a time.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from pop_fast.blocks.parts import block_folder, core_of, marker_of
from pop_fast.blocks.plan import read_plan
from pop_fast.data.capture import View
from pop_fast.errors import PopError
from pop_fast.io.atomic import write_atomically
from pop_fast.io.read_back import read_json
from pop_fast.stages.activations import opacities_from_logits, scales_from_log_scales
from pop_fast.stages.splatting import ProjectionSettings, covariances, project
from pop_fast.train.checkpoint import load_splats
from pop_fast.train.config import TrainConfig
from pop_fast.train.model import KEYS

__all__ = ["Start", "check_merged", "own_of", "read_core", "read_start", "shown_in", "write_counts"]

# Gaussians that are projected at a time: some 20 MB
_AT_A_TIME = 65_536
_COUNTS = "start.json"


@dataclass(frozen=True)
class Start:
    """What a block starts from.

    Attributes:
        params: raw parameters: first those that are trained, then those that are held fixed.
        own: how many are trained.
        merged: how many Gaussians there are in all cores.
    """

    params: dict[str, Tensor]
    own: int
    merged: int

    @property
    def fixed(self) -> dict[str, Tensor]:
        """Return a copy of the rows that are held fixed."""
        return {key: value[self.own :].clone() for key, value in self.params.items()}


def check_merged(folder: Path, number: int) -> list[str]:
    """Return the names of the blocks of a run in which a round can begin.

    Args:
        folder: the run's.
        number: of the round, from 1.

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
    """Read the merged Gaussians of a block's core that a round starts from.

    Args:
        folder: the run's.
        name: of the block.
        number: of the round, from 1.
    """
    return load_splats(core_of(folder, name, number - 1))[0]


def read_start(folder: Path, name: str, number: int, config: TrainConfig, views: Sequence[View]) -> Start:
    """Read what a block starts from in a round.

    Args:
        folder: the run's.
        name: of the block.
        number: of the round, from 1.
        config: profile and antialiasing are read.
        views: of the block, to train on and held out.

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
    """Tell which Gaussians at least one view shows, behind others or not. bool [N]

    Args:
        views: with their cameras; photographs are not read.
        params: raw parameters.
        config: profile and antialiasing are read.
    """
    profile = config.renderer
    cameras = [
        (
            torch.from_numpy(view.viewmat).float(),
            ProjectionSettings(
                torch.from_numpy(view.K).float(), view.width, view.height, profile, antialiased=config.antialiased
            ),
        )
        for view in views
    ]
    shown = torch.zeros(len(params["means"]), dtype=torch.bool)
    for rows in torch.arange(len(shown)).split(_AT_A_TIME):
        means, opacities = params["means"][rows], opacities_from_logits(params["opacities"][rows])
        shapes = covariances(params["quats"][rows], scales_from_log_scales(params["scales"][rows]))
        for viewmat, settings in cameras:
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
    text = json.dumps(counts) + "\n"
    write_atomically(block_folder(folder, name, number) / _COUNTS, lambda file: file.write(text.encode()))


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
