"""The options of `pop train` that divide a capture into blocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro


@dataclass(frozen=True, kw_only=True)
class BlocksOptions:
    """How a capture is divided.

    Attributes:
        blocks: divide the ground of a capture that is larger than memory, as 2x2, into strips and parts of them; each
            block is trained by itself, and the blocks are merged.
        blocks_margin: what a block is trained on beyond its core, as a share of the core's size.
        blocks_share: a view from elsewhere trains a block whose core holds at least this share of the points in its
            picture.
        blocks_rounds: how often the merged blocks are trained on: each round trains what a block has in its core among
            all others as they are, and merges again. With --resume a finished run takes further rounds. (default: 2)
        blocks_round_steps: steps of a block in a round. (default: a tenth of --max-steps)
        blocks_jobs: how many blocks are trained at a time on this machine; more than one needs Snakemake.
        blocks_profile: hand the blocks to a cluster by this Snakemake profile: slurm, or a folder of yours.
    """

    blocks: str | None = None
    blocks_margin: float = 0.2
    blocks_share: float = 0.25
    blocks_rounds: Annotated[int | None, tyro.conf.arg(help_behavior_hint="")] = None
    blocks_round_steps: Annotated[int | None, tyro.conf.arg(help_behavior_hint="")] = None
    blocks_jobs: int = 1
    blocks_profile: str | None = None
