"""Row operations against a model that keeps each Gaussian as one dictionary: nothing may come apart.

Every row carries a tag; its other values and its moments are functions of what happened to it, so a value that strays
to another row shows at once. The machine runs over the oracle and over the row operations that train.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from pop_ref import density as oracle
from pop_ref.conformance.backends import shipped
from pop_ref.optimizer import adam_step

KEYS = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": ()}
LEARNING_RATE = {name: 0.0 if name == "sh0" else 0.125 for name in KEYS}
MOST_ROWS = 24


@dataclass
class Member:
    """One Gaussian of the model."""

    params: dict[str, list[float]]
    m: dict[str, list[float]]
    v: dict[str, list[float]]

    def child(self, **changed: list[float]) -> Member:
        """Return a copy with other parameters and no history."""
        zeros = {name: [0.0] * len(value) for name, value in self.params.items()}
        return Member({**self.params, **changed}, zeros, dict(zeros))


def member(tag: int) -> Member:
    wave = [math.sin(1.0 + tag + 3 * k) for k in range(4)]
    params = {"means": wave[:3], "scales": wave[1:], "quats": wave, "opacities": [2.0 * wave[0]], "sh0": [float(tag)]}
    return Member(params, *({name: [0.0] * len(value) for name, value in params.items()} for _ in range(2)))


def rotated(quat: list[float], point: list[float]) -> list[float]:
    """Rotate by p -> p + 2 w (u x p) + 2 u x (u x p) with the unit quaternion (w, u)."""
    norm = math.sqrt(sum(c * c for c in quat))
    w, *u = (c / norm for c in quat)
    once = [u[(k + 1) % 3] * point[(k + 2) % 3] - u[(k + 2) % 3] * point[(k + 1) % 3] for k in range(3)]
    twice = [u[(k + 1) % 3] * once[(k + 2) % 3] - u[(k + 2) % 3] * once[(k + 1) % 3] for k in range(3)]
    return [point[k] + 2.0 * (w * once[k] + twice[k]) for k in range(3)]


class RowMachine(RuleBasedStateMachine):
    """Apply the same edits to arrays and to the model."""

    def operation(self, name: str) -> Any:
        return getattr(oracle, name)

    def edit(self, name: str, *args: Any) -> None:
        after = self.operation(name)(*args)
        self.rows = oracle.Rows(after.params, after.m, after.v)

    @initialize(n=st.integers(0, 4))
    def start(self, n: int) -> None:
        self.model = [member(tag) for tag in range(n)]
        self.updates = 0
        params = {
            name: np.array([g.params[name] for g in self.model], dtype=np.float64).reshape(n, *shape)
            for name, shape in KEYS.items()
        }
        self.edit("rows_from_params", params)

    def chosen(self, data: st.DataObject) -> tuple[list[bool], Any]:
        n = len(self.model)
        picks = data.draw(st.lists(st.booleans(), min_size=n, max_size=n), label="mask")
        return picks, np.array(picks, dtype=bool)

    @rule(data=st.data())
    @precondition(lambda self: len(self.model) <= MOST_ROWS)
    def clone(self, data: st.DataObject) -> None:
        picks, mask = self.chosen(data)
        self.edit("clone_rows", self.rows, mask)
        self.model += [g.child() for g, pick in zip(self.model, picks, strict=True) if pick]

    @rule(data=st.data())
    @precondition(lambda self: len(self.model) <= MOST_ROWS)
    def split(self, data: st.DataObject) -> None:
        picks, mask = self.chosen(data)
        n_split = sum(picks)
        normals = np.cos(np.arange(6.0 * n_split)).reshape(2, n_split, 3)
        self.edit("split_rows", self.rows, mask, normals)
        parents = [g for g, pick in zip(self.model, picks, strict=True) if pick]
        self.model = [g for g, pick in zip(self.model, picks, strict=True) if not pick]
        for child in range(2):
            for parent, eps in zip(parents, normals[child].tolist(), strict=True):
                log_scales, mean = parent.params["scales"], parent.params["means"]
                offset = rotated(
                    parent.params["quats"], [math.exp(s) * e for s, e in zip(log_scales, eps, strict=True)]
                )
                moved = [a + b for a, b in zip(mean, offset, strict=True)]
                self.model.append(parent.child(means=moved, scales=[s - math.log(1.6) for s in log_scales]))

    @rule(data=st.data())
    def prune(self, data: st.DataObject) -> None:
        picks, mask = self.chosen(data)
        self.edit("prune_rows", self.rows, mask)
        self.model = [g for g, pick in zip(self.model, picks, strict=True) if not pick]

    @rule(ceiling=st.sampled_from([0.01, 0.25]))
    def reset(self, ceiling: float) -> None:
        self.edit("reset_opacities", self.rows, ceiling)
        logit = math.log(ceiling / (1.0 - ceiling))
        for g in self.model:
            g.params["opacities"] = [min(g.params["opacities"][0], logit)]
            g.m["opacities"], g.v["opacities"] = [0.0], [0.0]

    @rule()
    def train(self) -> None:
        """Give every row its own gradient, so that its moments tell it from the others."""
        self.updates += 1
        arrays = [{name: np.asarray(a) for name, a in part.items()} for part in self.parts()]
        grads = {name: np.cos(array) for name, array in arrays[0].items()}
        updated = adam_step(arrays[0], grads, arrays[1], arrays[2], self.updates, LEARNING_RATE)
        self.rows = oracle.Rows(*updated)
        for g in self.model:
            lists = [{name: np.array(value) for name, value in part.items()} for part in (g.params, g.m, g.v)]
            grads = {name: np.cos(value) for name, value in lists[0].items()}
            new = adam_step(lists[0], grads, lists[1], lists[2], self.updates, LEARNING_RATE)
            g.params, g.m, g.v = ({name: value.tolist() for name, value in part.items()} for part in new)

    def parts(self) -> tuple[Any, Any, Any]:
        return self.rows.params, self.rows.m, self.rows.v

    @invariant()
    def rows_are_the_models(self) -> None:
        assert len(self.rows) == len(self.model)
        for kind, part in zip(("params", "m", "v"), self.parts(), strict=True):
            for name, shape in KEYS.items():
                expected = np.array([getattr(g, kind)[name] for g in self.model], dtype=np.float64)
                array = np.asarray(part[name])
                assert array.shape == (len(self.model), *shape)
                np.testing.assert_allclose(array, expected.reshape(array.shape), rtol=1e-10, atol=1e-12)
        # tags are never computed with, so they are exact
        assert np.asarray(self.rows.params["sh0"]).tolist() == [g.params["sh0"][0] for g in self.model]


class TrainedRowMachine(RowMachine):
    def operation(self, name: str) -> Any:
        return shipped("fast64").stage(name)


TestOracleRows = RowMachine.TestCase
TestTrainedRows = TrainedRowMachine.TestCase
