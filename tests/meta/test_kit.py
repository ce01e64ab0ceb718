"""The checks checked: scenes survive pasting and storing, strategies cover what they promise, reports say enough."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.backends import Absent, shipped_or_absent
from pop_ref.conformance.failure_report import failure_report
from pop_ref.conformance.law import missing
from pop_ref.conformance.mutants import MUTANTS, living
from pop_ref.conformance.mutants.trial import every_law, law_named, obeys
from pop_ref.conformance.scenes import (
    Scene,
    cotangents,
    golden_scene,
    load_scene,
    rounded_to,
    save_scene,
    scene_as_code,
)
from pop_ref.conformance.scorecard import Entry, Scorecard, outcomes
from pop_ref.conformance.strategies import FLOOR, scenes
from pop_ref.conformance.tolerances import TABLE
from pop_ref.conformance.torch_strategy import StrategyAdapter
from pop_ref.constants import INRIA
from pop_ref.records import Camera, Gaussians
from tests.judged import POISONED_INTEGER, poisoned_allocations

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


def test_a_comparison_reports_index_values_and_units() -> None:
    with pytest.raises(AssertionError, match=r"first at \[1\].*differs by .* units, allowed") as caught:
        assert_close("alpha.sigma", np.array([1.0, 2.5]), np.array([1.0, 2.0]), 1.0, np.float64)
    assert "got 2.5, expected 2.0" in str(caught.value)


def test_one_wrong_entry_among_a_million_fails() -> None:
    expected = np.zeros(1_000_000)
    actual = expected.copy()
    actual[123_456] = 1e-6
    with pytest.raises(AssertionError, match=r"first at \[123456\]"):
        assert_close("alpha.sigma", actual, expected, 1.0, np.float32)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_never_passes(bad: float) -> None:
    with pytest.raises(AssertionError, match="not finite"):
        assert_close("alpha.sigma", np.array([bad]), np.array([1.0]), 1e300, np.float64)


def test_shapes_must_agree() -> None:
    with pytest.raises(AssertionError, match="shape"):
        assert_close("alpha.sigma", np.zeros(2), np.zeros((2, 1)), 1.0, np.float64)
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


def _kit(*options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    command += ["--pyargs", "pop_ref.conformance", *options]
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
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:hypothesispytest",
        "--profile=cpu",
    ]
    done = subprocess.run([*command, str(tmp_path)], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--rasterizer", "no_such.module:f"), "no_such.module:f needs no_such, which is not installed"),
        (("--rasterizer", "numpy"), "'numpy' must be written module:name, as my.module:rasterization"),
        (("--rasterizer", "math:exp"), "math:exp draws nothing on cpu: a first small picture raises TypeError"),
        (("--rasterizer", "math:exp", "--profile", "gsplat_2"), "profile 'gsplat_2' is unknown; use one of paper"),
        (("--adapter", "pathlib:Path"), "pathlib:Path makes no adapter: it has no dtype"),
        (("--backend", "gsplt"), "backend 'gsplt' is unknown; use one of oracle, fast64"),
        (("--scorecard", "card.txt"), "scorecard card.txt must end in .json or .html"),
        (("--stage", "order"), "invalid choice: 'order' (choose from"),
    ],
    ids=lambda value: value[1] if isinstance(value, tuple) else None,
)
def test_the_kit_refuses_what_it_cannot_judge(words: tuple[str, ...], said: str) -> None:
    done = _kit(*words, "-k", "grid")
    assert done.returncode == 4, done.stdout + done.stderr
    assert said in done.stdout + done.stderr
    assert len((done.stdout + done.stderr).strip().splitlines()) < 8


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


@pytest.mark.parametrize("shift", [pytest.param(0.0, marks=pytest.mark.slow), 0.5])
def test_a_stranger_with_gsplats_signature_is_judged_by_what_it_offers(
    tmp_path: Path, shift: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    # nothing but gsplat's arguments and meta keys; with half a pixel's shift it must fail and say where
    (tmp_path / "stranger.py").write_text(STRANGER.format(shift=shift))
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{ROOT}")
    done = _kit("--rasterizer", "stranger:rasterization", "--dtype", "float64", "--profile", "gsplat_1_5", "-rs",
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


def test_one_cause_that_breaks_several_laws_is_told_once_with_where_it_was_raised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "stranger.py").write_text(PACKED.format(shift=0.0))
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{ROOT}")
    chosen = "packed_rows_are_those or arguments_that_are_taken_alone or sparse_gradients"
    options = ("--profile", "gsplat_1_5", "-v", "-k", chosen, "--failures", str(tmp_path))
    done = _kit("--rasterizer", "stranger:rasterization", *options)
    _, _, told = done.stdout.partition("= conformance =")
    assert "stranger:rasterization: 0 laws hold, broken 2, not judged 1" in told, done.stdout
    assert told.count("with packed=True and backgrounds together, and not with fewer: answer: fails an assertion") == 1
    assert told.count("breaks: ") == 2
    assert f"raised at {tmp_path / 'stranger.py'}:" in done.stdout
    # a call that ends in an assertion does not hide that the argument is refused
    assert "sparse_grad (NotImplementedError: sparse_grad)" in " ".join(done.stdout.split())


def test_who_has_gsplat_and_nothing_else_reads_first_what_is_judged_and_what_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # nothing is said of constants: a module of that name tells them by its version
    (tmp_path / "gsplat.py").write_text(f'__version__ = "1.5.3"\n{STRANGER.format(shift=0.0)}')
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{ROOT}")
    done = _kit("-v", "--rasterizer", "gsplat:rasterization", "-k", "empty_scene")
    told = " ".join(done.stdout.split())
    assert done.returncode == 0, done.stdout + done.stderr
    assert "conformance: gsplat:rasterization, float32, constants gsplat_1_5, on cpu (--dtype, --profile" in told
    assert re.search(r"judged: \d+ of \d+ laws, of camera, footprint, tiles, alpha, compositing, gradients", told)
    assert "arguments taken: several cameras in one call; batch dimensions; packed rows; plain colours" in told
    assert "refused, and not judged: depth modes (TypeError: " in told
    assert "--strategy name an implementation that offers them next: a broken law prints where" in told


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
    backend = shipped_or_absent(name)
    if isinstance(backend, Absent):
        pytest.skip(backend.reason)
    K = [[8.0, 0.0, 2.0], [0.0, 8.0, 2.0], [0.0, 0.0, 1.0]]
    gaussians = Gaussians(
        means=[[0.078125, 0.078125, 2.5], [0.0625, 0.0625, 1.0]],
        quats=[[1.0, 0.0, 0.0, 0.0]] * 2,
        scales=[[0.3125] * 3, [0.125] * 3],
        opacities=[0.5, 1.0 / 255.0],
        sh=[[[1.0, 0.5, 0.25]], [[0.0, 0.0, 0.0]]],
    )
    scene = Scene(gaussians, Camera(np.eye(4), np.array(K), 4, 4), tile_size=4)
    sentence = law_named(f"test_gradients:{law}").sentence
    settings(max_examples=1, database=None)(given(scene=st.just(scene))(lambda scene: sentence(backend, scene=scene)))()


@pytest.mark.parametrize("name", ["fast32", "compiled32"])
def test_a_weight_is_charged_for_an_exponent_that_is_expanded_about_a_tile_far_from_it(name: str) -> None:
    # the last splat is a point widened by the low-pass alone; its pixel lies 8 px from the middle of its tile, so that
    # terms of 200 cancel in its exponent
    backend = shipped_or_absent(name)
    if isinstance(backend, Absent):
        pytest.skip(backend.reason)
    near = [0.4871794879436493, 0.10256410390138626, 1.0]
    gaussians = Gaussians(
        means=[[1.0897436141967773, 0.12820513546466827, 2.5], near, near, near, [0.28205129504203796, *near[1:]]],
        quats=[[1.0, 0.0, 0.0, 0.0]] * 5,
        scales=[[0.5128205418586731] * 3, *[[0.20512820780277252] * 3] * 3, [0.0] * 3],
        opacities=[0.5, 0.5, 0.5, 1.0 / 255.0, 0.99],
        sh=[[[1.0, 0.5, 0.25]], *[[[0.0] * 3]] * 4],
    )
    K = [[4.875, 0.0, 0.125], [0.0, 4.875, 2.0], [0.0, 0.0, 1.0]]
    scene = Scene(gaussians, Camera(np.eye(4), np.array(K), 4, 4), tile_size=16)
    sentence = law_named("test_agreement:dominant_weights_are_the_oracles").sentence
    settings(max_examples=1, database=None)(given(scene=st.just(scene))(lambda scene: sentence(backend, scene=scene)))()


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


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("nowhere.at_all:Strategy", "needs nowhere, which is not installed"),
        ("math:Strategy", "module math has no function Strategy"),
        ("math", "must be written module:name"),
    ],
)
def test_a_strategy_that_is_not_there_is_one_line(path: str, words: str) -> None:
    done = _kit("--strategy", path, "--stage", "training")
    assert done.returncode == 4
    assert words in done.stderr
    assert "Traceback" not in done.stderr
