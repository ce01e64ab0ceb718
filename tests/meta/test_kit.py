"""The checks checked: scenes survive pasting and storing, strategies cover what they promise, reports say enough.

A failing law's report names the right cause, and is about the example that broke the law. The examples that tests draw
are the same on every machine, whatever is installed or imported.
"""

from __future__ import annotations

import contextlib
import importlib
import inspect
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import entry_points
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jaxtyping import TypeCheckError

from pop_fast.api.rasterize import rasterization as fast
from pop_ref.activations import scales_from_log_scales
from pop_ref.conformance import laws, pytest_entry
from pop_ref.conformance.adapter import OracleAdapter, View
from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.backends import shipped
from pop_ref.conformance.calls import Call, call_as_code
from pop_ref.conformance.capabilities import ALL_BANDS
from pop_ref.conformance.failure_report import failure_report
from pop_ref.conformance.hypothesis_profiles import EXAMPLES
from pop_ref.conformance.law import is_crash, missing
from pop_ref.conformance.mutants import BLACK_BOXES, MUTANTS, living
from pop_ref.conformance.mutants.trial import every_law, law_named, obeys
from pop_ref.conformance.pairs import FACTORS, accepted, call_of, covering_rows, judged_pairs, pairs_of, possible_pairs
from pop_ref.conformance.plugin import _kind_of
from pop_ref.conformance.scenes import (
    Scene,
    cotangents,
    golden_scene,
    load_scene,
    rounded_to,
    save_scene,
    scene_as_code,
)
from pop_ref.conformance.scorecard import Entry, Scorecard, introduction, outcomes
from pop_ref.conformance.short_training import _assert_whose
from pop_ref.conformance.signature import made
from pop_ref.conformance.strategies import FLOOR, corners, scenes
from pop_ref.conformance.tolerances import TABLE
from pop_ref.conformance.torch_adapter import TorchAdapter
from pop_ref.conformance.torch_strategy import StrategyAdapter
from pop_ref.constants import INRIA
from pop_ref.covariance import covars_from_quats_scales
from pop_ref.losses import l2
from pop_ref.records import Camera, Gaussians
from tests.judged import POISONED_INTEGER, here, poisoned_allocations

ROOT = Path(__file__).resolve().parents[2]
SEEN = settings(max_examples=200, derandomize=True, database=None, suppress_health_check=list(HealthCheck))


def _same(one: Scene, other: Scene) -> bool:
    return repr(one) == repr(other)


@given(scene=scenes(max_degree=2))
def test_a_printed_scene_can_be_pasted(scene: Scene) -> None:
    scope: dict[str, object] = {}
    exec(scene_as_code(scene.with_overrides(profile=INRIA, background=[0.25, 0.5, 1.0])), scope)
    pasted = scope["scene"]
    assert isinstance(pasted, Scene)
    assert _same(pasted, scene.with_overrides(profile=INRIA, background=[0.25, 0.5, 1.0]))


def test_a_stored_scene_is_the_same_scene(tmp_path: Path) -> None:
    scene = golden_scene().with_overrides(tile_size=4, antialiased=True)
    save_scene(tmp_path / "deep" / "scene.npz", scene)
    assert _same(load_scene(tmp_path / "deep" / "scene.npz"), scene)


def test_the_strategies_reach_what_they_promise() -> None:
    drawn: list[Scene] = []

    @SEEN
    @given(scene=scenes(max_side=16, max_degree=3))
    def collect(scene: Scene) -> None:
        drawn.append(scene)

    collect()
    opacities = np.concatenate([s.gaussians.opacities for s in drawn])
    assert np.any((opacities > 0.0) & (opacities < FLOOR)), "no opacity under 1/255"
    assert np.any(opacities == FLOOR), "no opacity at 1/255"
    assert np.any(opacities == 1.0), "no opacity at 1"
    assert np.any(opacities == 0.0), "no opacity at 0"
    assert any(len(s.gaussians) == 0 for s in drawn), "no empty scene"
    assert any(s.camera.width == s.camera.height == 16 for s in drawn)
    assert max(max(s.camera.width, s.camera.height) for s in drawn) == 16
    assert any(np.any(s.camera.viewmat[:3, :3] != np.eye(3)) for s in drawn), "no turned camera"
    assert any(s.camera.K[0, 2] != s.camera.width / 2 for s in drawn), "no principal point off the centre"
    assert {s.gaussians.sh.shape[1] for s in drawn} == {1, 4, 9, 16}
    depths = np.concatenate([s.gaussians.means @ s.camera.viewmat[2, :3] + s.camera.viewmat[2, 3] for s in drawn])
    assert np.any(depths < 0.0), "nothing behind the camera"
    means = [tuple(m) for s in drawn for m in s.gaussians.means.tolist()]
    assert len(set(means)) < len(means), "no coincident copies"


def test_cotangents_are_nowhere_zero() -> None:
    v_image, v_T_final = cotangents(golden_scene())
    assert np.all(v_image != 0.0)
    assert np.all(v_T_final != 0.0)
    assert np.any(v_image < 0.0)
    assert np.any(v_image > 0.0)


def test_rounding_a_scene_twice_is_rounding_it_once() -> None:
    once = rounded_to(golden_scene(), np.float32)
    assert _same(rounded_to(once, np.float32), once)
    assert not _same(once, golden_scene())


@pytest.mark.parametrize(
    ("actual", "expected", "scale", "dtype", "said"),
    [
        ([1.0, 2.5], [1.0, 2.0], 1.0, np.float64, r"first at \[1\].*differs by .* units, allowed"),
        ([1.0, 2.5], [1.0, 2.0], 1.0, np.float64, "got 2.5, expected 2.0"),
        # one wrong entry among a million
        (np.where(np.arange(10**6) == 123_456, 1e-6, 0.0), np.zeros(10**6), 1.0, np.float32, r"first at \[123456\]"),
        *(([bad], [1.0], 1e300, np.float64, "not finite") for bad in (np.nan, np.inf, -np.inf)),
        ([1.0], [np.nan], 1.0, np.float64, "got 1.0, expected nan is not finite"),
        ([1.0], [2.0], np.nan, np.float64, "got 1.0, expected 2.0"),
        (np.zeros(2), np.zeros((2, 1)), 1.0, np.float64, "shape"),
    ],
    ids=["index", "values", "million", "nan", "inf", "-inf", "expected", "magnitude", "shape"],
)
def test_what_differs_is_told_with_index_values_and_units(actual, expected, scale, dtype, said):
    with pytest.raises(AssertionError, match=said):
        assert_close("alpha.sigma", np.array(actual), np.array(expected), scale, dtype)


def test_a_row_without_numbers_is_another_row() -> None:
    with pytest.raises(AssertionError, match="step 0 left another Gaussian at row 1"):
        _assert_whose(np.array([[0.0], [np.nan]]), np.zeros((2, 1)), "step 0")


def test_bits_of_other_shapes_are_not_the_same() -> None:
    with pytest.raises(AssertionError, match="shape"):
        assert_same_bits("x", np.zeros(2), np.zeros(3))


@pytest.mark.parametrize("key", sorted(TABLE))
def test_no_tolerance_is_far_above_the_worst_case_that_was_measured(key: str) -> None:
    tolerance = TABLE[key]
    assert tolerance.units >= 4.0 * tolerance.worst, "no room over the worst case that was measured"
    assert tolerance.units <= 16.0 * tolerance.worst or tolerance.units == 1.0, "room that no measurement asked for"


def test_a_failing_law_tells_stage_gaussian_pixel_decision_and_scene() -> None:
    by_name = {mutant.name: mutant for mutant in MUTANTS}
    with living(by_name["jacobian_sign"]) as backend:
        text = failure_report("test_some_law", backend, {"scene": golden_scene()})
    assert "law some_law fails on jacobian_sign" in text
    assert "first stage that differs: projection_jacobians, Gaussian" in text
    assert "first pixel that differs: " in text
    assert "nearest decision at that pixel: D" in text
    assert "scene = Scene(gaussians=Gaussians(means=" in text


def test_the_scorecard_counts_by_backend_and_stage(tmp_path: Path) -> None:
    card = Scorecard("mine")
    card.entries = [
        Entry("a", "alpha", "sigma_is_right", "passed", "", 0.5),
        Entry("a", "alpha", "floor_is_right", "failed", "differs <by> 3", 0.5),
        Entry("a", "camera", "it_looks_ahead", "skipped", "a has no camera", 0.0),
    ]
    assert card.summary()["a"] == {
        "camera": {"passed": 0, "failed": 0, "skipped": 1},
        "alpha": {"passed": 1, "failed": 1, "skipped": 0},
    }
    card.write(tmp_path / "card.json")
    card.write(tmp_path / "card.html")
    told = json.loads((tmp_path / "card.json").read_text())
    assert told["summary"] == card.summary()
    assert told["laws"]["a"]["alpha"] == {"passed": ["sigma_is_right"], "failed: differs <by> 3": ["floor_is_right"]}
    assert outcomes(told["laws"]["a"]["alpha"])["floor_is_right"] == "failed: differs <by> 3"
    assert told["made"]["seconds"] == 1
    page = (tmp_path / "card.html").read_text()
    assert "floor is right" in page
    assert "differs &lt;by&gt; 3" in page


KIT = ("-q", "-p", "no:cacheprovider", "--pyargs", "pop_ref.conformance")


def _kit(*options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pytest", *KIT, *options]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT / "docs")


def test_the_kit_runs_from_the_command_line_and_writes_a_scorecard(tmp_path: Path) -> None:
    card = tmp_path / "card.json"
    done = _kit("--rasterizer", "pop_fast.api:rasterization", "--stages", "pop_fast.stages", "--stage", "camera",
                "--dtype", "float64", "--profile", "paper", "--scorecard", str(card))  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    told = json.loads(card.read_text())
    assert set(told["summary"]["pop_fast.api:rasterization"]) == {"camera"}
    (laws,) = told["laws"]["pop_fast.api:rasterization"].values()
    assert "a rigid motion keeps distances".replace(" ", "_") in laws["passed"]
    assert all(came == "passed" or came.startswith("skipped: ") for came in laws)
    surface = told["surface"]["pop_fast.api:rasterization"]
    assert (surface["profile"], surface["dtype"]) == ("any", "float64")
    assert "several cameras in one call" in surface["arguments"]["offered"]
    assert "sparse_grad" in surface["arguments"]["not"]
    assert "covars_cam_from_covars" in surface["stage functions"]["offered"]
    assert told["made"]["cpu seconds"]["pop_fast.api:rasterization"] >= 1
    assert told["made"]["hypothesis profile"]


def test_a_session_that_judges_nothing_is_left_alone(tmp_path: Path) -> None:
    # pytest loads the kit's entry point in every session; options of the kit's names may then be somebody else's
    (entry,) = {entry for entry in entry_points(group="pytest11") if entry.name == "pop_conformance"}
    (tmp_path / "conftest.py").write_text("def pytest_addoption(parser): parser.addoption('--profile')\n")
    (tmp_path / "test_mine.py").write_text(
        "import sys\ndef test_mine(request):\n    assert request.config.getoption('--profile') == 'cpu'\n"
        f"    assert {entry.value!r} in sys.modules\n"
        "    assert not {'pop_ref', 'torch'} & set(sys.modules)\n"
    )
    plugins = ["-p", "no:cacheprovider", "-p", "no:hypothesispytest"]
    command = [sys.executable, "-m", "pytest", "-q", *plugins, "--profile=cpu"]
    done = subprocess.run([*command, str(tmp_path)], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_session_without_hypothesis_is_told_which_extra_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pytest_entry, "find_spec", lambda name: None)
    with pytest.raises(pytest.UsageError, match=r"the laws need hypothesis: pip install 'pop-ref\[conformance\]'"):
        pytest_entry.pytest_load_initial_conftests(None, ["--pyargs", "pop_ref.conformance"])


# a run of the kit for each, in one process
REFUSING = """
import contextlib, io, json, sys
import pytest
told = []
for words in json.loads(sys.argv[1]):
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
        status = pytest.main(words)
    told.append((status, text.getvalue()))
print(json.dumps(told))
"""


REFUSED = {
    ("--rasterizer", "no_such.module:f"): "no_such.module:f needs no_such, which is not installed",
    ("--rasterizer", "numpy"): "'numpy' must be written module:name, as my.module:rasterization",
    ("--rasterizer", "math:exp"): "math:exp draws nothing on cpu: a first small picture raises TypeError",
    ("--rasterizer", "math:exp", "--profile", "gsplat_2"): "profile 'gsplat_2' is unknown; use one of paper",
    (
        "--backend",
        "oracle",
        "--profile",
        "inria",
    ): "--profile is read with --rasterizer; backends,",
    (
        "--program",
        "true",
        "--dtype",
        "float64",
    ): "--dtype is read with --rasterizer; backends,",
    ("--adapter", "pathlib:Path"): "pathlib:Path makes no adapter: it has no dtype, has, stage",
    ("--backend", "gsplt"): "backend 'gsplt' is unknown; use one of oracle, fast64",
    ("--scorecard", "card.txt"): "scorecard card.txt must end in .json or .html",
    ("--scorecard", "kit.md/card.html"): "card.html cannot be written: ",
    ("--stage", "order"): "invalid choice: 'order' (choose from",
    ("--strategy", "nowhere.at_all:Strategy"): "needs nowhere, which is not installed",
    ("--strategy", "math:Strategy"): "module math has no function Strategy",
    ("--strategy", "math"): "must be written module:name",
    ("--stages", "nowhere.at_all"): "nowhere.at_all needs nowhere, which is not installed and not in",
    ("--stages", "json"): "json has no stage modules",
}


@pytest.fixture(scope="module")
def refusals() -> dict[tuple[str, ...], tuple[int, str]]:
    words = json.dumps([[*KIT, *words, "-k", "grid"] for words in REFUSED])
    done = subprocess.run([sys.executable, "-c", REFUSING, words], capture_output=True, text=True, cwd=ROOT / "docs")
    assert done.returncode == 0, done.stderr
    return dict(zip(REFUSED, json.loads(done.stdout), strict=True))


@pytest.mark.parametrize("words", REFUSED, ids=" ".join)
def test_the_kit_refuses_what_it_cannot_judge(refusals, words):
    status, text = refusals[words]
    assert status == 4, text
    assert REFUSED[words] in text
    assert len(text.strip().splitlines()) < 8


def test_a_backend_that_is_not_here_is_skipped_with_the_reason(tmp_path: Path) -> None:
    card = tmp_path / "card.json"
    done = _kit("--backend", "diff-gaussian-rasterization", "--stage", "dominance", "-rs", "--scorecard", str(card))
    assert done.returncode == 0, done.stdout + done.stderr
    (laws,) = json.loads(card.read_text())["laws"]["diff-gaussian-rasterization"].values()
    (came,) = laws
    assert came.startswith("skipped: diff-gaussian-rasterization needs ")
    assert came.removeprefix("skipped: ") in done.stdout


def test_poison_reaches_what_the_package_allocates_and_nothing_else() -> None:
    import torch

    before = torch.empty
    theirs: dict[str, object] = {"__name__": "accused.stage", "torch": torch}
    with poisoned_allocations("accused"):
        exec("a = torch.empty(3); b = torch.ones(2).new_empty(2); c = torch.empty(2, dtype=torch.int64)", theirs)
        ours = torch.empty(3).fill_(1.0)
        assert torch.all(torch.isnan(theirs["a"]))  # type: ignore[arg-type]
        assert torch.all(torch.isnan(theirs["b"]))  # type: ignore[arg-type]
        assert theirs["c"].tolist() == [POISONED_INTEGER] * 2  # type: ignore[attr-defined]
        assert torch.all(ours == 1.0)
    assert torch.empty is before


STRANGER = """
from pop_fast.api.rasterize import rasterization as sound

def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane=0.01, far_plane=1e10,
                  radius_clip=0.0, eps2d=0.3, sh_degree=None, packed=True, tile_size=16, backgrounds=None,
                  absgrad=False, rasterize_mode="classic"):
    Ks = Ks.clone()
    Ks[..., 0, 2] += {shift}
    image, alphas, meta = sound(means, quats, scales, opacities, colors, viewmats, Ks, width, height,
                                sh_degree=sh_degree, packed=packed, tile_size=tile_size, backgrounds=backgrounds,
                                absgrad=absgrad, rasterize_mode=rasterize_mode)
    return image, alphas, {{"means2d": meta["means2d"], "radii": meta["radii"]}}
"""


Judged = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def stranger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Judged:
    """Give a function that writes a rasterizer into a module and has the kit judge it."""

    def judged(text: str, *options: str, name: str = "stranger") -> subprocess.CompletedProcess[str]:
        (tmp_path / f"{name}.py").write_text(text)
        monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{ROOT}")
        return _kit("--rasterizer", f"{name}:rasterization", *options)

    return judged


@pytest.mark.parametrize("shift", [pytest.param(0.0, marks=pytest.mark.slow), 0.5])
def test_a_stranger_with_gsplats_signature_is_judged_by_what_it_offers(stranger, tmp_path, shift):
    # nothing but gsplat's arguments and meta keys; with half a pixel's shift it must fail and say where
    done = stranger(STRANGER.format(shift=shift), "--dtype", "float64", "--profile", "gsplat_1_5", "-rs",
                    "-k", "round_splat or stop_itself or any_tile", "--failures", str(tmp_path / "broken"))  # fmt: skip
    assert "has no stops" in done.stdout, done.stdout + done.stderr
    assert done.returncode == (1 if shift else 0), done.stdout + done.stderr
    if shift:
        assert "a_round_splat_on_the_axis_looks_as_the_formula_says" in done.stdout
        # no code of the kit, and at the end what breaks
        assert "def assert_close(" not in done.stdout
        assert "a round splat on the axis looks as the formula says" in done.stdout.partition(" laws hold, broken ")[2]


# as gsplat 1.5.3, whose assertion about backgrounds counts packed rows (gsplat#764), and that refuses sparse_grad
PACKED = STRANGER.replace("absgrad=False,", "sparse_grad=False, absgrad=False,").replace(
    "    Ks = Ks.clone()",
    "    assert backgrounds is None or not packed\n"
    "    if sparse_grad:\n        raise NotImplementedError('sparse_grad')\n    Ks = Ks.clone()",
)


@pytest.mark.slow
def test_one_cause_that_breaks_several_laws_is_told_once_with_where_it_was_raised(stranger, tmp_path):
    chosen = "packed_rows_are_those or arguments_that_are_taken_alone or sparse_gradients"
    options = ("--profile", "gsplat_1_5", "-v", "-k", chosen, "--failures", str(tmp_path))
    done = stranger(PACKED.format(shift=0.0), *options)
    _, _, told = done.stdout.partition("= conformance =")
    assert "stranger:rasterization: 0 laws hold, broken 2, not judged 1" in told, done.stdout
    assert told.count("with packed=True and backgrounds together, and not with fewer: answer: fails an assertion") == 1
    assert told.count("breaks: ") == 2
    assert f"raised at {tmp_path / 'stranger.py'}:" in done.stdout
    # a call that ends in an assertion does not hide that the argument is refused
    assert "sparse_grad (NotImplementedError: sparse_grad)" in " ".join(done.stdout.split())


def test_what_differs_in_one_gradient_is_told_once_wherever_it_differs() -> None:
    told = ["AssertionError: autograd.v_means: first at [0, 1]", "with packed=True: gradients: agreement.v_means: a",
            "with every argument at its default: gradients: agreement.v_means: Gaussian 0", "image: pixel (0, 0)",
            "first gradient that differs: v_means, Gaussian 1, entry [0]"]  # fmt: skip
    assert len({_kind_of(told[k]) for k in (0, 2, 4)}) == 1
    assert len(set(map(_kind_of, told))) == 3


def test_who_has_gsplat_and_nothing_else_reads_first_what_is_judged_and_what_is_refused(stranger: Judged) -> None:
    # nothing is said of constants: a module of that name tells them by its version
    text = f'__version__ = "1.5.3"\n{STRANGER.format(shift=0.0)}'
    done = stranger(text, "-v", "-k", "empty_scene", name="gsplat")
    told = " ".join(done.stdout.split())
    assert done.returncode == 0, done.stdout + done.stderr
    assert "conformance: gsplat:rasterization, float32, constants gsplat_1_5, on cpu (--dtype, --profile" in told
    assert re.search(r"judged: \d+ of \d+ laws, of camera, footprint, tiles, alpha, compositing, gradients", told)
    assert "arguments taken: several cameras in one call; batch dimensions; packed rows; plain colours" in told
    assert "refused, and not judged: depth modes (TypeError: " in told
    assert "--strategy name an implementation that offers them next: a broken law prints where" in told


def _obeys_on(name: str, law: str, gaussians: Gaussians, K: Any, tile_size: int) -> None:
    """Hold a backend to a law on a scene of 4 x 4 pixels that a camera at the origin sees."""
    backend = here(name)
    scene = Scene(gaussians, Camera(np.eye(4), np.array(K), 4, 4), tile_size=tile_size)
    sentence = law_named(law).sentence
    settings(max_examples=1, database=None)(given(scene=st.just(scene))(lambda scene: sentence(backend, scene=scene)))()


@pytest.mark.parametrize("name", ["fast32", "compiled32"])
@pytest.mark.parametrize(
    "law",
    [
        "the_background_gradient_is_the_cotangent_seen_through_the_remaining_light",
        "the_colour_gradient_is_what_the_colour_adds_to_the_image",
    ],
)
def test_no_law_compares_a_render_with_a_gradient_where_rounding_decides(law: str, name: str) -> None:
    # the alpha of the nearer splat at pixel (2, 2) is the floor to 6e-8, and tiles of another size round it to its
    # other side
    K = [[8.0, 0.0, 2.0], [0.0, 8.0, 2.0], [0.0, 0.0, 1.0]]
    gaussians = Gaussians(
        means=[[0.078125, 0.078125, 2.5], [0.0625, 0.0625, 1.0]],
        quats=[[1.0, 0.0, 0.0, 0.0]] * 2,
        scales=[[0.3125] * 3, [0.125] * 3],
        opacities=[0.5, 1.0 / 255.0],
        sh=[[[1.0, 0.5, 0.25]], [[0.0, 0.0, 0.0]]],
    )
    _obeys_on(name, f"test_gradients:{law}", gaussians, K, 4)


@pytest.mark.parametrize("name", ["fast32", "compiled32"])
def test_a_weight_is_charged_for_an_exponent_that_is_expanded_about_a_tile_far_from_it(name: str) -> None:
    # the last splat is a point widened by the low-pass alone; its pixel lies 8 px from the middle of its tile, so that
    # terms of 200 cancel in its exponent
    near = [0.4871794879436493, 0.10256410390138626, 1.0]
    gaussians = Gaussians(
        means=[[1.0897436141967773, 0.12820513546466827, 2.5], near, near, near, [0.28205129504203796, *near[1:]]],
        quats=[[1.0, 0.0, 0.0, 0.0]] * 5,
        scales=[[0.5128205418586731] * 3, *[[0.20512820780277252] * 3] * 3, [0.0] * 3],
        opacities=[0.5, 0.5, 0.5, 1.0 / 255.0, 0.99],
        sh=[[[1.0, 0.5, 0.25]], *[[[0.0] * 3]] * 4],
    )
    K = [[4.875, 0.0, 0.125], [0.0, 4.875, 2.0], [0.0, 0.0, 1.0]]
    _obeys_on(name, "test_agreement:dominant_weights_are_the_oracles", gaussians, K, 16)


class _OneCall:
    """A sound strategy as gsplat's are: it collects and changes in one call."""

    def __init__(self, refine_every: int = 100, refine_start_iter: int = 500, grow_grad2d: float = 2e-4) -> None:
        from pop_fast.density import GsplatStrategy

        given = {"refine_every": refine_every, "refine_start_iter": refine_start_iter, "grow_grad2d": grow_grad2d}
        self._own = GsplatStrategy(**given)
        self.initialize_state, self.step_pre_backward = self._own.initialize_state, self._own.step_pre_backward

    def step_post_backward(
        self, params: Any, optimizers: Any, state: Any, step: int, info: Any, packed: bool = False
    ) -> None:
        self._own.step_post_backward(params, optimizers, state, step, info, packed)


class _KeepsOldTensors(_OneCall):
    def step_post_backward(self, params: Any, optimizers: Any, *more: Any, **named: Any) -> None:
        held = {key: optimizer.param_groups[0]["params"] for key, optimizer in optimizers.items()}
        super().step_post_backward(params, optimizers, *more, **named)
        for key, optimizer in optimizers.items():
            optimizer.param_groups[0]["params"] = held[key]


class _FreezesAll(_OneCall):
    def step_post_backward(self, params: Any, optimizers: Any, *more: Any, **named: Any) -> None:
        super().step_post_backward(params, optimizers, *more, **named)
        for key, param in params.items():
            params[key] = param.detach()


def test_somebodys_strategy_is_judged_by_the_laws_that_are_about_no_method() -> None:
    def broken_laws(make: Any) -> set[str]:
        backend = StrategyAdapter(make.__name__, make)
        laws = {path: law for path, law in every_law().items() if law.stage == "training"}
        return {law.name for law in laws.values() if not missing(backend, law.needs) and obeys(law, backend)}

    assert broken_laws(_OneCall) == set()
    assert "after_every_step_each_optimizer_holds_its_parameter_and_nothing_else" in broken_laws(_KeepsOldTensors)
    assert "edited_parameters_are_trained_as_they_were" in broken_laws(_FreezesAll)


BOXES = {box.name: box for box in BLACK_BOXES}


def report(path: str, backend: Any) -> str:
    """Run a law as pytest does, and return its failure with the report."""
    module, _, name = path.partition(":")
    test = getattr(importlib.import_module(f"{laws.__name__}.{module}"), f"test_{name}")
    with pytest.raises(AssertionError) as caught:
        test(backend=backend)
    return "\n".join([str(caught.value), *caught.value.__notes__])


CAUSES = {
    "near_plane_ignored": ("first difference: images", "first cause: with near_plane=2\n"),
    "eps2d_ignored": ("first difference: images", "first cause: with eps2d=0.0625\n"),
    "radius_clip_ignored": ("first difference: images", "first cause: with radius_clip=6\n"),
    "background_of_the_camera_before": ("camera 0, pixel (", "first cause: with 2 cameras and backgrounds together"),
    "intrinsics_of_the_first_camera": ("camera 1, pixel (", "first cause: with 2 cameras\n"),
    "expected_depth_not_divided": ("first difference: images", "first cause: with render_mode='ED'\n"),
    "expected_depth_of_a_constant_opacity": ("first difference: gradients", "first cause: with render_mode='ED'\n"),
    "tiles_counted_in_a_byte": ("first difference: tiles: meta tiles_per_gauss", "tiles together"),
    "dominant_packed_rows": ("first difference: dominance: meta dominant_ids", "first cause: with packed=True\n"),
    "covariances_counted_once": ("first difference: gradients", "first cause: with covars\n"),
    "white_by_default": ("pixel (0, 0), channel 0: got 1.0, expected 0.0", "first cause: with backgrounds=None\n"),
    "dominant_counts_of_the_first_camera": ("dominant_counts beside dominant_ids, camera 1", "with 2 cameras\n"),
    "packed_is_classic": ("first difference: images", "with packed=True and rasterize_mode='antialiased' together"),
    "depth_of_the_first_entry": ("batch entry 1, pixel (", "with batch dimensions [2] and render_mode="),
    "packed_fails_with_backgrounds": ("fails an assertion of its own", "packed=True and backgrounds together"),
    "packed_view_gradients_are_of_one_camera": ("agreement.v_viewmat: camera 0", "2 cameras and packed=True together"),
}


@pytest.mark.slow  # a run of the kit for each of twelve
@pytest.mark.parametrize("name", CAUSES)
def test_the_report_of_a_broken_rasterizer_names_its_cause(name: str) -> None:
    text = report(BOXES[name].law, BOXES[name].adapter())
    for words in CAUSES[name]:
        assert words in text
    # stages are spoken of where they have been compared, and these show none before the pixel but in meta
    assert "stages" not in text


class WrongAlone(OracleAdapter):
    """The oracle, with a gradient of scales that is wrong for a scene of one Gaussian, the first that a law tries."""

    def gradients(self, scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, np.ndarray]:
        found = super().gradients(scene, v_image, v_T_final)
        return found | {"scales": found["scales"] * (1.0 + (len(scene.gaussians) == 1))}


def test_a_report_is_about_the_example_that_raised_the_error() -> None:
    text = report("test_agreement:gradients_are_the_oracles", WrongAlone())
    assert "first gradient that differs: v_scales, Gaussian 0" in text
    pasted: dict[str, Any] = {}
    exec(text[text.index("from pop_ref.conformance.scenes") :].partition("\nlaw ")[0], pasted)
    assert len(pasted["scene"].gaussians) == 1


class Darker(OracleAdapter):
    """The oracle with colours that are a little too dark: nothing before the pixel differs, nor does T_final."""

    def has(self, need: str) -> bool:
        return need in ("render", "gradients") or (super().has(need) and not need.isidentifier())

    def render(self, scene: Scene) -> View:
        view = super().render(scene)
        return View(**{**vars(view), "image": view.image * 0.75})


def test_what_follows_from_meta_is_said_only_as_far_as_it_follows() -> None:
    text = report("test_agreement:the_image_is_one_of_the_oracles_outcomes", Darker())
    assert "no stage that its meta shows differs: depths, means2d, conics, and so is T_final, so it is colours" in text


def test_a_printed_call_can_be_pasted() -> None:
    backend = shipped("fast32")
    rows = covering_rows(accepted(backend).levels)
    for number, row in enumerate(rows[:12]):
        call, scope = call_of(backend, row, number), {}
        exec(call_as_code(call), scope)
        pasted = scope["call"]
        assert isinstance(pasted, Call)
        assert (repr(pasted), pasted.described()) == (repr(call), call.described())
        for name, value in call.tensors().items():
            assert np.array_equal(value, pasted.tensors()[name])


def test_every_pair_of_levels_meets_in_some_row_and_every_level_moves_something() -> None:
    levels = {factor: tuple(one.name for one in values) for factor, values in FACTORS.items()}
    rows = covering_rows(levels)
    assert pairs_of(rows) >= set(possible_pairs(levels))
    assert len(rows) < 60
    backend = shipped("fast32")
    taken = covering_rows(accepted(backend).levels)
    clipped = [call_of(backend, row, k) for k, row in enumerate(taken) if row["radius_clip"] != "0"]
    assert len(clipped) > 10
    first = made(backend, clipped[0])
    assert any(np.any(~e.render.splats.visible) for _, _, e in first.each())


@pytest.mark.slow  # all pairs of arguments
def test_pairs_that_only_failing_calls_hold_are_named_and_count_as_not_judged() -> None:
    backend = BOXES["packed_fails_with_backgrounds"].adapter()
    assert judged_pairs(backend) == {}
    with pytest.raises(AssertionError) as caught:
        every_law()["test_signature_pairs:arguments_that_are_taken_alone_are_taken_together"].sentence(backend)
    assert is_crash(caught.value)
    found = judged_pairs(backend)
    assert found["judged"] < found["taken"] <= found["of"]
    assert "packed=True with backgrounds=given" in found["only in calls that fail"]
    assert found["by arguments"]["packed x backgrounds"] == "3 of 4"


@pytest.mark.slow  # all laws of the signature
@pytest.mark.parametrize(("argument", "keys"), [("tile_size", ()), ("backend", ("camera_ids", "batch_ids"))])
def test_a_sound_rasterizer_without_tile_size_or_camera_ids_breaks_no_law_of_the_signature(argument, keys):
    def rasterization(*args: Any, **options: Any) -> Any:
        images, alphas, meta = shipped("fast32")._rasterization(*args, **options)
        return images, alphas, {key: meta[key] for key in meta if key not in keys}

    without = {"profile", "dominance", "counts", "backend", argument}
    taken = [p for name, p in inspect.signature(fast).parameters.items() if name not in without]
    rasterization.__signature__ = inspect.Signature(taken)  # type: ignore[attr-defined]
    backend = TorchAdapter("sound", rasterization, dtype="float32")
    judged = 0
    for path, stated in every_law().items():
        if path.startswith("test_signature") and not [need for need in stated.needs if not backend.has(need)]:
            with contextlib.suppress(pytest.skip.Exception):
                stated.sentence(backend)
                judged += 1
    assert judged >= 24


UNHEARD_OF = (0.1234567, -77123.25, 31.0625)


def drawn(count: int = 400) -> list[float]:
    found: list[float] = []

    @settings(max_examples=count)
    @given(st.floats(-1e6, 1e6))
    def collect(value: float) -> None:
        found.append(value)

    collect()
    return found


@pytest.mark.parametrize("highest", [0, 1, 2])
def test_a_rasterizer_of_fewer_bands_is_judged_by_those_it_has(highest: int) -> None:
    def rasterization(*args: Any, sh_degree: int | None = None, **options: Any) -> Any:
        if (sh_degree or 0) > highest:
            raise ValueError(f"sh_degree is {sh_degree}; it must be <= {highest}")
        return fast(*args, sh_degree=sh_degree, **options)

    backend = TorchAdapter("of few bands", rasterization, dtype="float32")
    assert backend.first_error() is None
    assert f"harmonics up to degree {highest}" in " ".join(introduction(backend))
    assert ALL_BANDS in missing(backend, law_named("test_scale:the_image_of_fifty_is_the_oracles").needs)
    several = "test_signature_arguments:several_cameras_in_one_call_see_what_each_sees_alone"
    for law in ("test_agreement:gradients_are_the_oracles", several):
        assert obeys(law_named(law), backend, 1) is None
    found = accepted(backend)
    assert {"colors=harmonics of degree 3", "colors=degree 1 of 3"} <= found.refused.keys()
    assert ("colors=harmonics of degree 1" in found.refused) == (highest == 0)
    assert "harmonics of degree 0" in found.levels["colors"]


def test_the_constants_of_a_local_module_are_not_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = drawn()
    file = tmp_path / "a_local_module.py"
    file.write_text(f"VALUES = {UNHEARD_OF!r}\n")
    spec = spec_from_file_location("a_local_module", file)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "a_local_module", module)
    spec.loader.exec_module(module)
    after = drawn()
    assert not set(UNHEARD_OF) & set(after)
    assert after == before


@pytest.mark.parametrize("profile", [name for name in EXAMPLES if name != "explore"])
def test_every_profile_but_explore_ignores_seeds_and_what_earlier_runs_kept(profile: str) -> None:
    kept = settings.get_profile(profile)
    assert kept.derandomize
    assert kept.database is None
    assert kept.max_examples == EXAMPLES[profile]


@pytest.mark.slow
def test_exploring_draws_by_the_seed(tmp_path: Path) -> None:
    test = tmp_path / "test_drawn.py"
    test.write_text(
        "from hypothesis import given, strategies as st\n"
        "from pop_ref.conformance.hypothesis_profiles import load_profile\n"
        "load_profile('explore')\n"
        "@given(st.integers(0, 10**9))\n"
        "def test_it(n):\n"
        "    print('drew', n)\n"
    )

    def under(seed: int) -> list[str]:
        command = [sys.executable, "-m", "pytest", "-s", "-q", f"--hypothesis-seed={seed}", str(test)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        told = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment, check=True)
        return [line for line in told.stdout.splitlines() if "drew" in line]

    one = under(1)
    assert len(one) == EXAMPLES["explore"]
    assert under(1) == one
    assert under(2) != one


# What laws are tried on before anything is drawn: enough to kill what random scenes kill by luck.

IMAGE, GRADIENTS = "test_agreement:the_image_is_one_of_the_oracles_outcomes", "test_agreement:gradients_are_the_oracles"
DYING = {"sorted_by_distance": IMAGE, "gradient_of_unit_quaternions": GRADIENTS, "camera_in_world_axes": IMAGE}


@pytest.mark.parametrize(("name", "path"), DYING.items())
def test_a_mutant_dies_without_a_drawn_scene(name: str, path: str) -> None:
    (mutant,) = (each for each in MUTANTS if each.name == name)
    with living(mutant) as backend:
        assert obeys(law_named(path), backend, examples=0) is not None


def test_laws_of_rendering_and_gradients_are_tried_on_them_first() -> None:
    laws = [stated for stated in every_law().values() if "scene" in stated.strategies]
    tried = [stated for stated in laws if stated.first]
    assert len(tried) >= 35
    for stated in tried:
        for values in stated.first:
            assert set(values) == set(stated.strategies), stated.name


def test_the_scenes_hold_what_they_are_for() -> None:
    scenes = [values["scene"] for values in corners(3)]
    views = [OracleAdapter().render(scene) for scene in scenes]
    assert all(view.n_blended.max() >= 2 for view in views[1:])
    norms = np.concatenate([np.linalg.norm(scene.gaussians.quats, axis=1) for scene in scenes])
    assert norms.min() < 0.6
    assert norms.max() > 2.0
    assert all(scene.gaussians.sh.shape[1] == 16 for scene in scenes)
    assert all(not np.allclose(scene.camera.viewmat[:3, :3], np.eye(3)) for scene in scenes)
    assert any(scene.camera.width % scene.tile_size for scene in scenes)
    assert any(np.any(view.T_final < 1e-3) for view in views)
    # depth is not distance in the third of them
    scene = corners()[2]["scene"]
    p = scene.gaussians.means @ scene.camera.viewmat[:3, :3].T + scene.camera.viewmat[:3, 3]
    assert np.argsort(p[:, 2]).tolist() != np.argsort(np.linalg.norm(p, axis=1)).tolist()


# The shapes in the oracle's annotations are checked while tests run: the hook came before the modules.


@pytest.mark.parametrize(
    ("function", "given", "named"),
    [
        (covars_from_quats_scales, (np.zeros((2, 3)), np.ones((2, 3))), "quats"),
        # lengths that share a letter must be equal
        (covars_from_quats_scales, (np.ones((2, 4)), np.ones((3, 3))), "scales"),
        (l2, (np.zeros((2, 2, 3)), np.zeros((2, 3, 3))), ""),
        (scales_from_log_scales, (np.zeros((1, 3), dtype=np.float32),), ""),
    ],
    ids=["columns", "lengths", "widths", "float32"],
)
def test_a_wrong_shape_or_type_is_told(function: Callable[..., Any], given: tuple[Any, ...], named: str) -> None:
    with pytest.raises(TypeCheckError, match=named):
        function(*given)
