"""Steps of several views on emulated GPUs: the CPU's, and the same bits on any number of them."""

from __future__ import annotations

import functools
import itertools
import json
import shutil
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path

import pytest
import torch

from cuda_ext.host import emulate
from cuda_ext.render import lists
from cuda_ext.training.batch_step import RETURNED, SENT, STRETCH, BatchTrainer, held_bytes, step_bytes, stretches
from cuda_ext.training.step_buffers import Rows
from pop_fast.cli import main
from pop_fast.density import MiniSplattingStrategy, POPStrategy
from pop_fast.errors import PopError
from pop_fast.train import TrainingRun
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.ranks import ALONE, Ranks, join
from pop_fast.train.stepper import FusedStepper
from pop_fast.train.training_run import Watch
from tests.app.conftest import launched
from tests.app.test_resume import needs_gloo
from tests.app.tiny import assert_same_run, last_checkpoint, tiny_capture, tiny_config
from tests.cuda.conftest import FOLDER, emulated_engine
from tests.cuda.gpu.test_device_training import masked, mixed_sizes, records

SIZE = 4
# all of density control, with resets; dominance by the window, its blur by the last view, regularizers, masks and
# sizes; passes that set all Gaussians and their colours anew, draw some of them, and prune, and gradients that wait
RUNS = {
    "pop": ({}, lambda capture: capture),
    "window": (
        {
            "opacity_reg": 0.05,
            "scale_reg": 0.02,
            "strategy": {"pop_views": "window", "blur_window": "own_view", "lambda_entropy": 0.02},
        },
        lambda capture: masked(mixed_sizes(capture)),
    ),
    "gsplat": ({}, lambda capture: capture),
    "mini_splatting": (
        {
            "strategy": {
                "reinit_iters": (9,),
                "reinit_points": 400,
                "sample_iter": 16,
                "sampling_factor": 0.7,
                "prune_iter": 22,
                "prune_mass": 0.05,
                "sh_start_iter": 16,
                "means_rewind_iter": 0,
                "sh_rest_every": 4,
            },
        },
        lambda capture: capture,
    ),
}


def train(
    folder: Path, name: str, ranks: Ranks = ALONE, resume: bool = False, watch: Watch | None = None
) -> TrainingRun:
    changes, edit = RUNS[name]
    method = {"gsplat": "gsplat", "mini_splatting": "3dgs"}.get(name, "pop")
    own = tiny_config(folder / name, method).strategy
    kind = MiniSplattingStrategy if name == "mini_splatting" else type(own)
    changes = {"batch_size": SIZE, **changes, "strategy": kind(**{**vars(own), **changes.get("strategy", {})})}
    config = tiny_config(folder / name, method, **changes)
    run = TrainingRun(config, edit(tiny_capture()), engine=emulated_engine(), ranks=ranks, resume=resume, watch=watch)
    run.run()
    return run


def train_all(folder: Path) -> None:
    """What each process does."""
    patch = pytest.MonkeyPatch()
    emulate.install(patch, emulate.build(FOLDER))
    torch.set_num_threads(1)
    ranks = join()
    synchronize, exchanged = BatchTrainer.synchronize, []
    regroup, regrouped = BatchTrainer.regroup, []
    whole, gathered = BatchTrainer.whole, []
    steps, held_now = FusedStepper.steps, {}

    def noted(trainer: BatchTrainer) -> None:
        exchanged.append((trainer.step, trainer._bounds[-1]))
        synchronize(trainer)

    def changed(trainer: BatchTrainer, params: Rows, origins: Rows) -> None:
        copied = {key: params[key].clone() for key in trainer.apart if params[key].dim() == 1}
        regrouped.append((trainer._bounds[-1], dict(origins), copied))
        regroup(trainer, params, origins)

    def collected(trainer: BatchTrainer, everywhere: bool) -> Rows:
        gathered.append((trainer._bounds[-1], everywhere))
        return whole(trainer, everywhere)

    def stepped(stepper: FusedStepper, *given):
        found = steps(stepper, *given)
        held_now.update(held(stepper))
        return found

    looked = []

    def look(run: TrainingRun) -> None:
        looked.append((run.step, float(run.params["means"].detach().double().sum())))

    patch.setattr(BatchTrainer, "synchronize", noted)
    patch.setattr(BatchTrainer, "regroup", changed)
    patch.setattr(BatchTrainer, "whole", collected)
    patch.setattr(FusedStepper, "steps", stepped)
    for name in RUNS:
        exchanged.clear()
        regrouped.clear()
        gathered.clear()
        # one of the processes shows its run, for which all take fewer steps at a time
        run = train(folder, name, ranks, watch=look if name == "gsplat" and ranks.writes else None)
        trainer = run.stepper.fused
        told = trainer.received, len(trainer._of_place[0]), list(exchanged), list(regrouped), list(gathered), held_now
        torch.save(told, folder / f"{name}_{ranks.rank}.pt")
    torch.save(looked, folder / f"looked_{ranks.rank}.pt")
    (folder / f"failed_{ranks.rank}.txt").write_text(failing(folder, ranks))
    ranks.leave()


def failing(folder: Path, ranks: Ranks) -> str:
    """Train until a colour of the second process is no longer a number, and return what is said of that."""
    run = TrainingRun(
        tiny_config(folder / "failed", batch_size=2), tiny_capture(), engine=emulated_engine(), ranks=ranks
    )
    run.take_steps(2)
    if not ranks.writes:
        run.stepper.fused._apart["sh0"][47 - run.stepper.fused._first, 0, 2] = float("nan")
    with pytest.raises(PopError) as error:
        run.take_steps(3)
    return str(error.value)


def held(stepper: FusedStepper) -> dict[str, int]:
    """Count the bytes of the tensors that a process holds for Gaussians while steps are taken, each memory once."""
    trainer, of_adam = stepper.fused, [dict(of.state) for of in stepper._optimizers.values()]
    assert isinstance(trainer, BatchTrainer)
    found: dict[int, int] = {}

    def look(thing: object) -> None:
        if isinstance(thing, torch.Tensor) and thing.dim() > 0:
            storage = thing.untyped_storage()
            found[storage.data_ptr()] = storage.nbytes()
        elif isinstance(thing, Mapping):
            look(list(thing.values()))
        elif isinstance(thing, (list, tuple)):
            for part in thing:
                look(part)
        elif is_dataclass(thing):
            look([getattr(thing, part.name) for part in fields(thing)])

    counted = {}
    parts = {
        "whole": (trainer._whole, trainer.statistics, stepper._params, of_adam),
        "drawn": trainer._drawn,
        "own": (trainer._moments, trainer._gradients, trainer._counts, trainer._of_place),
    }
    for name, of in parts.items():
        before = len(found), sum(found.values())
        look(of)
        counted[name] = sum(found.values()) - before[1]
        assert len(found) > before[0]
    return counted


@pytest.fixture(scope="module")
def together(made_once: Callable[..., Path]) -> Path:
    reason = emulate.why_not()
    if reason is not None:
        pytest.skip(reason)

    def make(folder: Path) -> None:
        emulate.build(FOLDER)
        outcomes = launched([__file__, folder])
        assert [outcome.status for outcome in outcomes] == [0, 0], outcomes

    return made_once("emulated-together", make)


@dataclass
class Alone:
    """A run on one GPU: its folder, and of every view drawn the Gaussians then, its place, and those that it saw."""

    folder: Path
    run: TrainingRun
    seen: list[tuple[int, int, torch.Tensor]]


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Alone]:
    """What trains on one GPU under a name, once; the emulated one is there while a test runs."""
    folder = tmp_path_factory.mktemp("alone")

    @functools.cache
    def trained(name: str) -> Alone:
        seen: list[tuple[int, int, torch.Tensor]] = []
        projected = BatchTrainer._projected

        def noted(trainer: BatchTrainer, place: int, view: int, phase):
            of = projected(trainer, place, view, phase)
            seen.append((trainer._bounds[-1], place, of.seen.clone()))
            return of

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(BatchTrainer, "_projected", noted)
            run = train(folder, name)
        return Alone(folder / name, run, seen)

    return trained


@pytest.mark.slow  # two processes that train
@needs_gloo
@pytest.mark.parametrize("name", RUNS)
def test_two_gpus_train_to_the_bits_of_one(gpu, together: Path, alone, name: str) -> None:
    assert_same_run(together / name, alone(name).folder)
    assert records_of(together / name) == records_of(alone(name).folder)
    # density control had something to decide, and both owned Gaussians
    assert len(last_checkpoint(together / name)[".splats.means"]) > 70
    for rank in (0, 1):
        received, own, _, regrouped, *_ = torch.load(together / f"{name}_{rank}.pt")
        assert own >= STRETCH
        assert min(received[what] for what in ("splats", "sums", "rows")) > 0
        assert regrouped


@pytest.mark.slow  # two processes that train
@needs_gloo
@pytest.mark.parametrize("name", RUNS)
def test_two_gpus_exchange_the_bytes_that_the_model_says(gpu, together: Path, alone, name: str) -> None:
    run, seen = alone(name).run, alone(name).seen
    told = [torch.load(together / f"{name}_{rank}.pt") for rank in (0, 1)]
    splats, sums = [0, 0], [0, 0]
    for n, place, rows in seen:
        # of four views the first two are drawn by the first process
        drawer, border = place // (SIZE // 2), stretches(n, 2)[1]
        crossing = int(((rows >= border) if drawer == 0 else (rows < border)).sum())
        splats[drawer] += 4 * SENT * crossing
        sums[1 - drawer] += 4 * RETURNED * crossing
    assert [received["splats"] for received, *_ in told] == splats
    assert [received["sums"] for received, *_ in told] == sums
    steps, shown = run.config.max_steps, sum(len(rows) for _, _, rows in seen) / sum(n for n, _, _ in seen)
    assert 0.1 < shown <= 1.0
    exchanges = told[0][2]
    assert exchanges == told[1][2]
    # all rows are read after a change of the Gaussians, a phase and a milestone, not after every step
    assert 1 < len(exchanges) < steps
    n = round(sum(n for n, _, _ in seen) / len(seen))
    model = step_bytes(n, 2, SIZE, shown, 1, n_rest=run.params["shN"].shape[1])
    for what in ("splats", "sums"):
        assert sum(received[what] for received, *_ in told) == pytest.approx(2 * steps * model[what], rel=0.1), what
    rows = sum(2 * step_bytes(n, 2, SIZE, shown, 1)["rows"] + waiting(run) * n for _, n in exchanges)
    assert sum(received["rows"] for received, *_ in told) == pytest.approx(rows, rel=1e-9)


def waiting(run: TrainingRun) -> int:
    """Return the bytes of a Gaussian's gradients that wait for their update, which no model counts."""
    return 4 * run.params["shN"][0].numel() if run.config.strategy.sh_rest_every > 1 else 0


@pytest.mark.slow  # two processes that train
@needs_gloo
@pytest.mark.parametrize("name", RUNS)
def test_moments_go_to_who_owns_their_rows_after_a_change(gpu, together: Path, alone, name: str) -> None:
    numbers = {key: value[0].numel() for key, value in alone(name).run.params.items()}
    told = [torch.load(together / f"{name}_{rank}.pt") for rank in (0, 1)]
    crossing = [0, 0]
    for n, origins, _ in told[0][3]:
        for key, rows in origins.items():
            for rank, count in enumerate(rows_that_cross(n, rows)):
                crossing[rank] += 2 * 4 * numbers[key] * count
    assert [received["moments"] for received, *_ in told] == crossing
    # the model tells the most: every row goes to another process
    most = sum(2 * step_bytes(len(origins["means"]), 2, SIZE, 1.0, 1)["moments"] for _, origins, _ in told[0][3])
    assert sum(crossing) <= most
    if name == "gsplat":
        assert sum(crossing) > 0


def rows_that_cross(n: int, rows: torch.Tensor) -> tuple[int, int]:
    """Count the rows that either of two processes gets from the other, of `n` rows before, by their numbers."""
    former, border = stretches(n, 2)[1], stretches(len(rows), 2)[1]
    return int((rows[:border] > former).sum()), int(((rows[border:] > 0) & (rows[border:] <= former)).sum())


@pytest.mark.slow  # two processes that train
@needs_gloo
@pytest.mark.parametrize("name", RUNS)
def test_colors_go_to_who_owns_their_rows_or_writes_or_looks_at_views(gpu, together: Path, alone, name: str) -> None:
    run = alone(name).run
    told = [torch.load(together / f"{name}_{rank}.pt") for rank in (0, 1)]
    # for a change that looks at the training views both have all colours, and none is sent after it
    passes = [step for step in range(run.config.max_steps) if run.strategy.needs_passes(step)]
    expected, most = [0, 0], 0.0
    for n, origins, copied in told[0][3]:
        most += 2 * step_bytes(len(origins["means"]), 2, SIZE, 1.0, 1)["colors"] if copied else 0.0
        for key, rows in copied.items():
            # every copy has its colours from somewhere
            assert int(rows.min()) >= 1
            assert torch.equal(rows[origins[key] > 0], origins[key][origins[key] > 0])
            for rank, count in enumerate(rows_that_cross(n, rows)):
                expected[rank] += 4 * run.params[key][0].numel() * count
    assert sum(expected) <= most
    assert sum(not copied for *_, copied in told[0][3]) == len(passes) == (3 if name == "mini_splatting" else 0)
    gathered = told[0][4]
    assert gathered == told[1][4]
    assert sum(everywhere for _, everywhere in gathered) == len(passes)
    for n, everywhere in gathered:
        border, each = stretches(n, 2)[1], 4 * sum(run.params[key][0].numel() for key in ("sh0", "shN"))
        expected[0] += each * (n - border)
        expected[1] += each * border * everywhere
    assert [received["colors"] for received, *_ in told] == expected


@pytest.mark.slow  # two processes that train
@needs_gloo
def test_who_watches_a_run_of_two_gpus_sees_the_rows_of_both(gpu, together: Path, tmp_path: Path) -> None:
    seen: dict[int, float] = {}

    def look(run: TrainingRun) -> None:
        seen[run.step] = float(run.params["means"].detach().double().sum())

    train(tmp_path, "gsplat", watch=look)
    looked = dict(torch.load(together / "looked_0.pt"))
    # how many steps come at a time is also a matter of their seconds
    common = seen.keys() & looked.keys()
    assert len(common) > 3
    assert {step: looked[step] for step in common} == {step: seen[step] for step in common}
    assert torch.load(together / "looked_1.pt") == []


@pytest.mark.slow  # two processes that train
@needs_gloo
def test_one_gpu_continues_what_two_began(gpu, together: Path, tmp_path: Path) -> None:
    folder = tmp_path / "window"
    shutil.copytree(together / "window", folder)
    kept = [path for number, path in ckpt.list_checkpoints(folder) if number < 29]
    ckpt.checkpoint_path(folder, 29).unlink()
    # in the middle of a window
    assert (ckpt.list_checkpoints(folder)[-1][0] + 1) % 4
    assert kept
    train(tmp_path, "window", resume=True)
    assert_same_run(folder, together / "window")


def test_buffers_that_overflow_in_a_step_of_several_views_lose_nothing(gpu, alone, tmp_path: Path, monkeypatch) -> None:
    whole = alone("window").run
    monkeypatch.setattr(lists, "FIRST_GUESS", (0, 1))
    cramped = train(tmp_path / "cramped", "window")
    assert cramped.stepper.facts()["instance_buffers_grown"] > 0
    assert whole.stepper.facts()["instance_buffers_grown"] == 0
    for key, value in whole.params.items():
        assert torch.equal(cramped.params[key], value), key


@pytest.mark.parametrize("sh_interval", [1000, 1], ids=["first band", "all bands"])
def test_a_step_of_several_views_has_the_cpus_gradients_and_statistics(gpu, tmp_path: Path, sh_interval: int) -> None:
    strategy = POPStrategy(refine_start_iter=50, blur_start_iter=0, blur_window="sum")
    found = []
    for engine in (None, emulated_engine()):
        config = tiny_config(tmp_path / str(engine is None), batch_size=3, strategy=strategy, sh_interval=sh_interval)
        run = TrainingRun(config, masked(mixed_sizes(tiny_capture())), engine=engine)
        # a sphere has no rotation to be moved by
        run.params["scales"].data += 0.3 * torch.randn((60, 3), generator=torch.Generator().manual_seed(4))
        run.take_steps(1)
        run.take_steps(2)
        run.stepper.synchronize()
        found.append((run.stepper.moments(), run.state))
    (moments, state), (wanted, of_cpu) = found[1], found[0]
    for key, group in wanted.items():
        for name in ("exp_avg", "exp_avg_sq"):
            most = float(group[name].abs().max())
            assert most > 0 or (key == "shN" and sh_interval == 1000), key
            assert float((moments[key][name] - group[name]).abs().max()) <= 1e-3 * most, (key, name)
    torch.testing.assert_close(state["grad2d"], of_cpu["grad2d"], rtol=1e-3, atol=1e-6)
    for name in ("count", "dominant_sum"):
        assert torch.equal(state[name].long(), of_cpu[name].long()), name
    assert state["views"] == of_cpu["views"] == 6
    assert int(state["dominant_sum"].sum()) > 0


def test_a_number_that_is_not_finite_is_found_in_a_step_of_several_views(gpu, tmp_path: Path) -> None:
    config = tiny_config(tmp_path, batch_size=2)
    run = TrainingRun(config, tiny_capture(), engine=emulated_engine())
    run.take_steps(2)
    run.params["quats"].data[47, 2] = float("nan")
    with pytest.raises(PopError, match=r"quats\[47, 2\] is nan after 2 steps"):
        run.take_steps(3)


@pytest.mark.slow  # two processes that train
@needs_gloo
def test_a_color_that_is_not_finite_is_found_by_its_owner_and_named_by_all(gpu, together: Path) -> None:
    for rank in (0, 1):
        assert "sh0[47, 0, 2] is nan after 2 steps" in (together / f"failed_{rank}.txt").read_text()


@pytest.mark.slow  # two processes that train
@needs_gloo
@pytest.mark.parametrize("name", RUNS)
def test_two_gpus_hold_the_bytes_that_the_model_says(gpu, together: Path, alone, name: str) -> None:
    run = alone(name).run
    n, n_rest = len(run.params["means"]), run.params["shN"].shape[1]
    told = [torch.load(together / f"{name}_{rank}.pt")[-1] for rank in (0, 1)]
    model = held_bytes(n, 2, SIZE, 1.0, n_rest)
    for of in told:
        assert of["whole"] == model["whole"] + waiting(run) * n
        assert 0 < of["drawn"] <= model["drawn"]
    # a block's sums of the regularizers are not in the model
    assert sum(of["own"] for of in told) == pytest.approx(2 * model["own"], rel=0.01)


class _Together:
    """What threads that play processes exchange."""

    def __init__(self, size: int) -> None:
        self.barrier, self.sent = threading.Barrier(size, timeout=60), [[torch.empty(0)]] * size


class _ThreadRanks(Ranks):
    """A thread that plays one of several processes."""

    def __init__(self, rank: int, size: int, together: _Together) -> None:
        self.rank, self.size, self._together = rank, size, together

    def share(self, whole: torch.Tensor, bounds: Sequence[int]) -> None:
        own = whole[slice(*bounds[self.rank : self.rank + 2])].clone()
        lengths = [last - first for first, last in itertools.pairwise(bounds)]
        whole.copy_(torch.cat(self.exchange([own] * self.size, lengths)))

    def exchange(self, sent: Sequence[torch.Tensor], received: Sequence[int]) -> list[torch.Tensor]:
        self._together.sent[self.rank] = list(sent)
        self._together.barrier.wait()
        found = [of[self.rank].clone() for of in self._together.sent]
        self._together.barrier.wait()
        assert [len(rows) for rows in found] == list(received)
        return found


@pytest.mark.parametrize("size", [1, 2, 3, 5])
@pytest.mark.parametrize(("n", "after"), [(0, 70), (40, 300), (300, 40), (300, 0), (1000, 1100)])
def test_moments_follow_their_rows_to_any_owner(size: int, n: int, after: int) -> None:
    generator = torch.Generator().manual_seed(after)
    tails = {"means": (3,), "opacities": (), "shN": (2, 3)}
    colors = torch.rand((n, 2, 3), generator=generator)
    m, v = ({key: torch.rand((n, *tail), generator=generator) for key, tail in tails.items()} for _ in range(2))
    # rows in any order, some several times, some new; each parameter has its own, as after a reset of opacities
    origins = {key: torch.randint(0, n + 1, (after,), generator=generator, dtype=torch.int32) for key in tails}
    copied = torch.randint(1, n + 1, (after,), generator=generator).double() if n else torch.zeros(after).double()
    together, found, wholes = _Together(size), [{} for _ in range(size)], [() for _ in range(size)]

    def play(rank: int) -> None:
        trainer = object.__new__(BatchTrainer)
        trainer._ranks, trainer._bounds = _ThreadRanks(rank, size, together), stretches(n, size)
        trainer.received = {"moments": 0, "colors": 0}
        own = slice(*trainer._bounds[rank : rank + 2])
        trainer._moments = tuple({key: rows[own].clone() for key, rows in of.items()} for of in (m, v))
        trainer._apart = {"shN": colors[own].clone()}
        moved = {
            key: trainer._moved("moments", [of.pop(key) for of in trainer._moments], origins[key]) for key in tails
        }
        trainer._apart = {"shN": trainer._own_rows("shN", copied)}
        trainer._moments, trainer._bounds = (
            tuple({key: moved[key][i] for key in tails} for i in (0, 1)),
            stretches(after, size),
        )
        found[rank] = trainer.moments()
        wholes[rank] = trainer.whole(everywhere=True), trainer.whole(everywhere=False)

    threads = [threading.Thread(target=play, args=(rank,)) for rank in range(size)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for key in tails:
        for name, of in (("exp_avg", m), ("exp_avg_sq", v)):
            padded = torch.cat((of[key].new_zeros((1, *of[key].shape[1:])), of[key]))
            assert torch.equal(found[0][key][name], padded[origins[key].long()]), (key, name)
            assert all(len(other[key][name]) == 0 for other in found[1:])
    padded = torch.cat((colors.new_zeros((1, 2, 3)), colors))[copied.long()]
    assert all(torch.equal(everywhere["shN"], padded) for everywhere, _ in wholes)
    assert torch.equal(wholes[0][1]["shN"], padded)
    assert not any(at_first for _, at_first in wholes[1:])


def test_a_warps_rows_have_one_owner() -> None:
    for n, size in ((0, 3), (1, 2), (60, 2), (64, 3), (1000, 7), (270_001, 8)):
        bounds = stretches(n, size)
        assert (bounds[0], bounds[-1], len(bounds)) == (0, n, size + 1)
        assert all(low <= high for low, high in itertools.pairwise(bounds))
        assert all(bound % STRETCH == 0 for bound in bounds[:-1] if bound < n)
        assert max(high - low for low, high in itertools.pairwise(bounds)) <= n / size + STRETCH


# `pop train` on a machine that claims eight GPUs, as torchrun starts it: argument 1 is the rank's file, the rest words
OF_EIGHT = """
import sys
import pytest
import torch
from cuda_ext.host import emulate
from pop_fast.cli import main
from pop_fast.train import engines
from tests.cuda.conftest import FOLDER, emulated_engine

patch, chosen = pytest.MonkeyPatch(), []
emulate.install(patch, emulate.build(FOLDER))
patch.setattr(engines, "whole_engine", lambda backend: emulated_engine())
patch.setattr(torch.cuda, "device_count", lambda: 8)
patch.setattr(torch.cuda, "set_device", chosen.append)
status = main(sys.argv[1:])
print("chosen", chosen, file=sys.stderr)
sys.exit(status)
"""


@pytest.mark.slow
@needs_gloo
def test_two_processes_on_a_machine_of_eight_gpus_train_on_two_of_them(gpu, tmp_path: Path) -> None:
    folder = tmp_path / "toy"
    assert main(["demo", str(folder), "--views", "8", "--width", "40", "--height", "32"]) == 0
    words = ["train", folder, "--out", tmp_path / "r", "--steps-scaler", "0.0003", "--no-progress"]
    words += ["--batch-size", "2", "--threads", "1", "--skip-sizes", "--skip-checks", "--max-renders", "1"]
    first, second = launched(["-c", OF_EIGHT, *words])
    assert (first.status, second.status) == (0, 0), (first.err, second.err)
    assert "backend cuda: there is a GPU, and the extension is built\nnote: 2 of 8 GPUs are used; torchrun" in first.out
    assert ("chosen [0]" in first.err, "chosen [1]" in second.err) == (True, True)
    stats = json.loads(next((tmp_path / "r" / "stats").glob("val_step*.json")).read_text())
    assert (stats["backend"], stats["stepper"]) == ("cuda", "cuda")


def records_of(folder: Path) -> list[dict]:
    return [
        {key: value for key, value in record.items() if key not in ("it_per_s", "seconds")}
        for record in records(folder)
    ]


if __name__ == "__main__":
    train_all(Path(sys.argv[1]))
