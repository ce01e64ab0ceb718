"""docs/trainer.md: its code runs, its prior is the oracle's. CITATION.cff and the workflows agree with the project."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st

from pop_ref.polarization import importance_mask
from pop_ref.polarization import pop_loss as oracle_loss

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "trainer.md").read_text(encoding="utf-8")
STEP, PRIOR = (compile(code, "docs/trainer.md", "exec") for code in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL))


def names_of(code: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    exec(code, found)
    return found


def scene() -> tuple[dict[str, torch.nn.Parameter], dict[str, torch.optim.Optimizer]]:
    rng = torch.Generator().manual_seed(0)
    n = 12
    means = torch.rand(n, 3, generator=rng) - 0.5
    means[:, 2] += 3.0
    values = {
        "means": means,
        "quats": torch.rand(n, 4, generator=rng) + 0.1,
        "scales": torch.full((n, 3), -2.0),
        "opacities": torch.zeros(n),
        "sh0": torch.rand(n, 1, 3, generator=rng),
        "shN": torch.zeros(n, 15, 3),
    }
    params = {name: torch.nn.Parameter(value) for name, value in values.items()}
    return params, {name: torch.optim.Adam([value], lr=1e-2, eps=1e-15) for name, value in params.items()}


@pytest.mark.filterwarnings("error::UserWarning")
def test_the_step_of_the_page_trains_with_the_prior_and_changes_the_gaussians() -> None:
    page = names_of(STEP)
    moved = {}
    for prior in (True, False):
        settings = {"refine_start_iter": 0, "refine_every": 4, "grow_grad2d": 0.0, "blur_stop_iter": -1}
        strategy = type(page["strategy"])(**settings, lambda_pop=10.0 if prior else 0.0)
        page["strategy"] = strategy
        params, optimizers = scene()
        state = strategy.initialize_state(1.0)
        K = torch.tensor([[16.0, 0.0, 8.0], [0.0, 16.0, 6.0], [0.0, 0.0, 1.0]])
        photograph = torch.zeros(12, 16, 3)
        losses = [
            page["step_with_prior"](step, params, optimizers, state, photograph, torch.eye(4), K) for step in range(4)
        ]
        assert losses[-1] < losses[0]
        moved[prior] = params["opacities"].detach().clone()
        losses += [page["step_with_prior"](4, params, optimizers, state, photograph, torch.eye(4), K)]
        assert len(params["means"]) > 12
        assert all(
            len(optimizer.param_groups[0]["params"][0]) == len(params["means"]) for optimizer in optimizers.values()
        )
    # with the prior some opacities rise, where the black photograph alone would lower every one
    assert (moved[True] > 0).any()
    assert not (moved[False] > 0).any()


@given(st.lists(st.tuples(st.floats(0.01, 0.99), st.integers(0, 2)), min_size=1, max_size=6))
def test_the_prior_of_the_page_is_the_oracles(rows: list[tuple[float, int]]) -> None:
    opacities, counts = np.array([o for o, _ in rows]), np.array([n for _, n in rows])
    ours = names_of(PRIOR)["pop_loss"](torch.tensor(opacities, dtype=torch.float64), torch.tensor(counts))
    assert ours.item() == pytest.approx(oracle_loss(opacities, importance_mask(counts)), rel=1e-12, abs=1e-15)


def test_authors_place_and_version_are_said_once_and_repeated_rightly() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert (cited["title"], cited["version"], cited["license"]) == (
        project["name"],
        project["version"],
        project["license"],
    )
    assert cited["repository-code"] == project["urls"]["Repository"]
    assert cited["authors"] == project["authors"]


@pytest.mark.parametrize("path", sorted((ROOT / ".github").rglob("*.yml")), ids=lambda path: path.stem)
def test_every_command_of_a_workflow_is_there(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert yaml.safe_load(text)
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert set(re.findall(r"\bmake ([a-z-]+)", text)) <= set(targets)
    assert all((ROOT / script).is_file() for script in re.findall(r"\bbash (\S+)", text))
