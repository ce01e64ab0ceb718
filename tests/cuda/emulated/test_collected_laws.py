"""The laws of what training steps collect, of the fused step under the emulator."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pop_fast.api.backend import get_backend
from pop_ref.conformance.mutants.trial import every_law, law_named
from pop_ref.conformance.torch_short_training import Trainee
from tests.cuda.conftest import emulated_engine

LAWS = [path for path, law in every_law().items() if law.needs == ("collected_statistics",)]


class FusedStep(Trainee):
    """Takes the steps of a `Watch` on the emulated GPU, as an adapter that offers nothing else."""

    name, dtype = "the fused step", np.float32

    def stage(self, name: str) -> Any:
        return getattr(self, name)

    def _engine(self, config: Any) -> Any:
        step = get_backend("cuda").whole_step()
        assert step is not None
        setting = step.unknown_setting(config)
        if setting is not None:
            pytest.skip(f"the fused step has no {setting}; `pop train` refuses it")
        return emulated_engine()


@pytest.mark.parametrize("path", LAWS)
def test_the_fused_step_collects_as_the_laws_say(gpu: Any, path: str) -> None:
    law_named(path).sentence(FusedStep("pop_fast", "cuda", "float32"))
