"""Train what a block has in its core among the Gaussians of other cores, which are held fixed."""

from __future__ import annotations

from collections.abc import Mapping

from pop_fast.blocks.start import Start
from pop_fast.data.capture import Capture
from pop_fast.train.config import TrainConfig
from pop_fast.train.engines import engine_of
from pop_fast.train.environment import keep_freed_memory
from pop_fast.train.fixed_rows import hold_last
from pop_fast.train.training_run import TrainingRun

__all__ = ["prepare"]


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
        config: its settings, of `pop_fast.train.refining`, with a backend's name.
        capture: the block's photographs.
        start: what it begins with.
        resume: continue from the latest checkpoint of `config.result_dir`, or start where there is none.
        loading_seconds: how long reading took, for the statistics.
        beside: texts to write beside cfg.json, by file name.
    """
    keep_freed_memory()
    engine = hold_last(engine_of(config), start.fixed)
    how = {"resume": resume, "loading_seconds": loading_seconds, "beside": beside}
    return TrainingRun(config, capture, initial=start.params, engine=engine, **how)
