"""Training: settings, the loop, checkpoints, measurements and the result folder."""

from __future__ import annotations

from pop_fast.train.config import LearningRates, TrainConfig
from pop_fast.train.trainer import Trainer

__all__ = ["LearningRates", "TrainConfig", "Trainer"]
