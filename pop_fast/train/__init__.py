"""Training: settings, the run and what takes its steps, checkpoints, measurements and the result folder."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pop_fast.lazy import given_by
from pop_fast.train.config import LearningRates, TrainConfig

if TYPE_CHECKING:
    from pop_fast.train.training_run import TrainingRun

__all__ = ["LearningRates", "TrainConfig", "TrainingRun"]

# settings need no torch
__getattr__ = given_by(__name__, {"training_run": ("TrainingRun",)})
