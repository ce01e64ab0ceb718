"""Training: settings, the run and what takes its steps, checkpoints, measurements and the result folder."""

from __future__ import annotations

from pop_fast.train.config import LearningRates, TrainConfig
from pop_fast.train.training_run import TrainingRun

__all__ = ["LearningRates", "TrainConfig", "TrainingRun"]
