"""Programs in other languages are judged over their standard input and output, whatever they answer."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given

from cuda_ext.toolkit import find_compiler, no_compiler
from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.assertions import assert_same_image
from pop_ref.conformance.capabilities import ALL_BANDS
from pop_ref.conformance.corpus import corpus_scene
from pop_ref.conformance.error_bounds import pixel_error_bounds
from pop_ref.conformance.gradient_error_bounds import gradient_error_bounds
from pop_ref.conformance.program_adapter import ProgramAdapter, ProgramError
from pop_ref.conformance.scenes import Record, Scene, cotangents, golden_scene, pack
from pop_ref.conformance.strategies import corners, scenes
from pop_ref.conformance.views import call_for
from pop_ref.constants import PAPER, Profile
from pop_ref.records import Camera

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


@pytest.fixture(scope="session")
def port(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The port in C++, compiled."""
    compiler = find_compiler()
    if compiler is None:
        pytest.skip(no_compiler())
    made = tmp_path_factory.mktemp("port") / "port"
    flags = ("-std=c++17", "-O1", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", f"-I{ROOT / 'cuda_ext/csrc'}")
    subprocess.run([*compiler, *flags, str(HERE / "port.cpp"), "-o", str(made)], check=True)
    return made


def bad(mode: str, timeout: float = 30.0) -> ProgramAdapter:
    return ProgramAdapter(f"{sys.executable} -S -E {HERE / 'bad_port.py'} {mode}", timeout)


def judged(
    folder: Path, program: str, stages: Sequence[str] = (), *options: str, profile: str = "dev"
) -> subprocess.CompletedProcess[str]:
    """Run the kit on a program as its users do."""
    environment = {**os.environ, "HYPOTHESIS_PROFILE": profile, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--pyargs", "pop_ref.conformance"]
    command += ["--program", program, *(word for stage in stages for word in ("--stage", stage)), *options]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment, check=False)


def n_passed(done: subprocess.CompletedProcess[str]) -> int:
    """Read how many laws held."""
    return int(done.stdout.split(" passed")[0].split()[-1])


@pytest.mark.slow  # it compiles a port
@pytest.mark.parametrize("words", ["", "double splats"])
def test_a_port_in_cpp_obeys_the_laws_of_images_and_gradients(port: Path, tmp_path: Path, words: str) -> None:
    stages = ("alpha", "compositing", "dominance", "gradients", "whole")
    done = judged(tmp_path, f"{port} {words}", stages)
    assert done.returncode == 0, done.stdout
    assert n_passed(done) >= 60, done.stdout


@pytest.mark.parametrize(
    ("right", "wrong", "status"),
    [("", "", 0), pytest.param("% w.width) + 0.5", "% w.width)", 1, marks=pytest.mark.slow)],
)
def test_the_port_of_the_page_obeys_the_laws_of_images_and_a_broken_one_does_not(
    tmp_path: Path, right: str, wrong: str, status: int
) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("the port of docs/port.md needs node, which is not here")
    page = (ROOT / "docs" / "port.md").read_text(encoding="utf-8")
    code = page.partition("```js\n")[2].partition("```")[0]
    assert right in code
    (tmp_path / "port.js").write_text(code.replace(right, wrong) if right else code, encoding="utf-8")
    done = judged(tmp_path, f"{node} port.js", ("compositing", "dominance", "whole"), profile="quick")
    assert done.returncode == status, done.stdout
    assert n_passed(done) >= (30 if status == 0 else 1), done.stdout


def oracle_port(*broken: str) -> str:
    """The command of a program that answers calls of functions with the oracle's results."""
    return shlex.join([sys.executable, str(HERE / "oracle_port.py"), *broken])


@pytest.mark.slow  # most laws, through a pipe
def test_losses_density_control_adam_and_calls_with_several_cameras_cross_a_pipe_without_loss(tmp_path: Path) -> None:
    stages = ("losses", "density", "optimizer", "signature", "gradients")
    done = judged(tmp_path, oracle_port(), stages, "-rs", profile="quick")
    assert done.returncode == 0, done.stdout
    # packed rows, and what only meta tells, are skipped
    assert n_passed(done) >= 90, done.stdout
    assert "refuses the request call rasterization: covariances are not supported" in done.stdout


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        ("quats", "v_viewmats, v_backgrounds, without v_quats"),
        ("centres", "v_means2d is the gradient of no argument"),
    ],
)
def test_gradients_of_a_call_are_of_all_its_gaussians_arguments_and_of_nothing_else(broken: str, words: str) -> None:
    scene = golden_scene()
    with pytest.raises(ProgramError, match=words):
        ProgramAdapter(oracle_port(broken)).gradients(scene, *cotangents(scene))


def test_a_program_of_fewer_bands_says_so_and_is_judged_by_those_it_has() -> None:
    backend = ProgramAdapter(oracle_port("bands"))
    backend.call(call_for(backend, degree=3))
    seen = backend.sees(corners(3)[0]["scene"])
    assert (backend.sh_degree, seen.degree) == (1, 1)
    assert not backend.has(ALL_BANDS)
    backend.render(seen)


@pytest.mark.parametrize(
    ("broken", "stage", "law"),
    [
        ("losses", "losses", "test_l2_is_the_oracles"),
        *(
            # one of them here, the others for `make test-all`
            pytest.param(*broken, marks=pytest.mark.slow)
            for broken in (
                ("density", "density", "the_small_are_cloned_and_the_large_are_split"),
                ("cameras", "signature", "several_cameras_in_one_call_see_what_each_sees_alone"),
                ("depth", "signature", "the_accumulated_depth_is_the_oracles"),
            )
        ),
    ],
)
def test_a_program_with_one_wrong_function_breaks_a_law_about_it(
    tmp_path: Path, broken: str, stage: str, law: str
) -> None:
    done = judged(tmp_path, oracle_port(broken), [stage], "-x", "-k", law, profile="quick")
    assert done.returncode == 1, done.stdout
    assert law in done.stdout


@pytest.mark.parametrize(
    ("mode", "words"),
    [
        ("call shapeless", "answers l2 with 'ok value': '' is no shape such as"),
        ("call negative", r"'\[-1\]' is no shape of an answer"),
        ("call huge", "is no shape of an answer"),
        ("call twice", "value is there twice"),
        ("call wide", r"value has shape \[2\]; it must be one number"),
        ("call nothing", "answers l2 with nothing: lacks value"),
        ("call draws", "answers 'draw 3', which begins neither with ok nor with error"),
        ("call refuses", "refuses the request call l2: not today"),
        ("call ends", "ended with status 4 before it had answered call l2"),
    ],
)
def test_a_function_that_answers_wrongly_is_named_with_what_is_wrong(mode: str, words: str) -> None:
    backend = bad(mode)
    for _ in range(2):
        with pytest.raises(ProgramError, match=words):
            backend.stage("l2")(np.zeros((2, 2, 3)), np.ones((2, 2, 3)))


@pytest.mark.parametrize("number", ["many", "-1", "1000001"])
def test_only_a_sound_number_of_deviates_is_drawn(number: str) -> None:
    asked: list[int] = []
    pipe = bad(f"draw {number}")._pipe
    with pytest.raises(ProgramError, match="it must be draw and a whole number up to 1000000"):
        pipe.ask("call densify_and_prune noise=draw", [], lambda n: asked.append(n) or np.zeros(n))
    assert asked == []


def test_a_port_says_how_large_its_error_is(port: Path) -> None:
    backend = ProgramAdapter(str(port))
    assert (backend.name, backend.dtype, backend.profile) == ("host", np.float32, None)
    scene = backend.sees(golden_scene())
    bounds, expected = pixel_error_bounds(scene, np.float32), OracleAdapter().render(scene)
    for view in (backend.render(scene), backend.plainly(scene)):
        assert_same_image("agreement.image", backend, view.image, expected.image, bounds, against_oracle=True)
    assert backend.plainly(scene).dominant_ids is None


SMALL = Camera(np.eye(4), np.array([[8.0, 0.0, 2.5], [0.0, 8.0, 2.5], [0.0, 0.0, 1.0]]), 5, 5)
# splats behind one another: an eighth is left where the stop is, a splat that ends a pixel would win it, and ceilings
STACKS = [((0.5,) * 4, replace(PAPER, transmittance_stop=0.125, stop_inclusive=each)) for each in (True, False)]
STACKS += [((0.25, 1.0), replace(PAPER, transmittance_stop=0.125))]
STACKS += [((1.0,) * 4, replace(PAPER, ceiling_gradient=each)) for each in ("zero", "pass")]


def stacked(opacities: tuple[float, ...], profile: Profile) -> Scene:
    records = [Record(2.5, 2.5, 1.0 + k, opacity=opacity) for k, opacity in enumerate(opacities)]
    return Scene(pack(records, SMALL), SMALL, profile=profile)


# fifty: more splats than one bucket of the way back by splats
FIXED = [golden_scene(), *(values["scene"] for values in corners(1)), *(stacked(*each) for each in STACKS)]
FIXED += [corpus_scene("fifty")]


@pytest.mark.parametrize("words", ["", "splats", "exact", "splats exact"])
def test_in_double_the_kernels_mathematics_draws_and_pulls_back_fixed_scenes_as_the_oracle_does(
    port: Path, words: str
) -> None:
    backend, oracle = ProgramAdapter(f"{port} double {words}"), OracleAdapter()
    for scene in FIXED:
        drawn, expected = backend.render(scene), oracle.render(scene)
        assert np.min(expected.T_final) < 0.9
        for name in ("image", "T_final", "dominant_weights"):
            np.testing.assert_allclose(getattr(drawn, name), getattr(expected, name), rtol=0, atol=1e-13, err_msg=name)
        for name in ("dominant_ids", "dominant_counts", "n_blended"):
            np.testing.assert_array_equal(getattr(drawn, name), getattr(expected, name), err_msg=name)
        v = cotangents(scene)
        found, gradients = backend.gradients(scene, *v), oracle.gradients(scene, *v)
        for name, value in gradients.items():
            scale = max(np.max(np.abs(value)), 2.0**-10)
            np.testing.assert_allclose(found[name], value, rtol=0, atol=1e-10 * scale, err_msg=name)


# a needle on the camera's axis: what it does to its rotation is a small difference of large numbers
NEEDLE = golden_scene().with_overrides(
    means=[[-2.5, 0.078125, 0.07812500000000054], [-1.0, 0.0625, 0.0625]],
    quats=[[1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 1.0, -1.0]],
    scales=[[0.3125, 0.3125, 0.3125], [8.0, 0.015625, 0.015625]],
    opacities=[0.5, 0.5],
    sh=[[[1.0, 0.5, 0.25]], [[0.0, 0.0, -0.125]]],
    sh_degree=0,
    viewmat=[[0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
)
# units of rounding by which the two ways back may part: ten times the most that 3,600 random scenes needed
APART = {"means": 0.02, "quats": 2e-4, "scales": 0.006, "opacities": 0.1, "sh": 4.0, "viewmat": 0.02}
APART |= {"means2d": 0.03, "means2d_abs": 0.1, "background": 0.1}


def test_both_ways_back_give_the_same_gradients(port: Path) -> None:
    columns, splats = (ProgramAdapter(f"{port} double {words}") for words in ("", "splats"))

    @example(scene=NEEDLE)
    @given(scene=scenes(anchored=True, max_gaussians=5))
    def hold(scene: Scene) -> None:
        v = cotangents(scene)
        bounds = gradient_error_bounds(scene, pixel_error_bounds(scene, np.float64), *v)
        other = splats.gradients(scene, *v)
        for name, value in columns.gradients(scene, *v).items():
            unit = np.finfo(np.float64).eps * bounds[name]
            assert np.all(np.abs(other[name] - value) <= APART[name] * unit), name

    hold()


@pytest.mark.parametrize("precision", ["", "double"])
def test_exact_lists_of_the_kernels_own_tiles_change_no_bit_of_the_image(port: Path, precision: str) -> None:
    plain, exact = (ProgramAdapter(f"{port} {precision} {words}") for words in ("", "exact"))

    @given(scene=scenes(max_gaussians=5))
    def hold(scene: Scene) -> None:
        drawn, expected = exact.render(scene), plain.render(scene)
        np.testing.assert_array_equal(drawn.image, expected.image)
        np.testing.assert_array_equal(drawn.dominant_ids, expected.dominant_ids)

    hold()


@pytest.mark.slow  # most laws, through a pipe
def test_a_black_port_breaks_laws_and_is_skipped_by_name_for_what_it_lacks(tmp_path: Path) -> None:
    command = f"{sys.executable} -S -E {HERE / 'bad_port.py'} black"
    done = judged(tmp_path, command, ("compositing", "gradients"), "-rs", profile="quick")
    assert done.returncode == 1
    assert "bad has no gradients" in done.stdout
    assert "failed" in done.stdout


@pytest.mark.parametrize(
    ("mode", "words"),
    [
        ("ends", "ended with status 1 before it had answered render, waiting for a line; it wrote to .* error: out of"),
        ("refuses", "refuses the request render: harmonics are not for me"),
        ("babbles", "answers 'image follows', which begins neither with ok nor with error"),
        ("stops halfway", "ended with status 3 before it had answered render, waiting for the"),
        ("forgets", "which lacks T_final, which was asked for"),
        ("invents", "which names 'colour', unknown or twice"),
        ("has no end", "bytes that hold no line"),
        ("splits", "dominant_ids that are not whole numbers"),
    ],
)
def test_what_a_program_does_wrong_is_said_and_it_is_started_again(mode: str, words: str) -> None:
    backend = bad(mode)
    for _ in range(2):
        with pytest.raises(ProgramError, match=words):
            backend.render(golden_scene())


def test_bytes_beyond_an_answer_are_noticed() -> None:
    backend = bad("says more")
    with pytest.raises(ProgramError, match=r"8 bytes more than its answer announces|begins neither with ok"):
        _twice(backend)


def _twice(backend: ProgramAdapter) -> None:
    # they may come after the answer has been read, and are then found before the next request
    for _ in range(2):
        backend.render(golden_scene())


def test_an_answer_that_does_not_come_is_not_waited_for_twice() -> None:
    backend = bad("hangs", timeout=2.0)
    with pytest.raises(ProgramError, match="took longer than 2 s to answer render, waiting for a line"):
        backend.render(golden_scene())
    with pytest.raises(ProgramError, match="took longer than 1 s"):
        backend.render(golden_scene())


@pytest.mark.parametrize(
    ("mode", "words"),
    [
        ("nameless", "without name; it must say ok name=NAME"),
        ("half", "dtype=float16; it must be one of float32, float64"),
        ("striped", "sh_degree=4; it must be one of 0, 1, 2, 3"),
        ("elsewhere", "profile=mine; it must be one of paper"),
        ("stranger", "offers 'colour'; what may be offered is image, T_final"),
        ("lonely", "offers no T_final; image, T_final belong together"),
        ("silent", "answers '', which begins neither with ok nor with error"),
    ],
)
def test_a_wrong_greeting_is_refused(mode: str, words: str) -> None:
    with pytest.raises(ProgramError, match=words):
        bad(mode)


def test_a_program_that_is_not_there_is_a_usage_error(tmp_path: Path) -> None:
    done = judged(tmp_path, "./no-such-port")
    assert done.returncode == 4
    assert "program ./no-such-port cannot be started" in done.stderr + done.stdout


def test_a_sound_greeting_is_read() -> None:
    backend = bad("sound")
    assert (backend.name, backend.dtype, backend.profile) == ("bad", np.float32, PAPER)
    assert [backend.has(need) for need in ("render", "dominance", "gradients")] == [True, True, False]
