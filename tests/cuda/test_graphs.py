"""What captures steps and fetches flags, with a recorder in torch's place: order, errors, the collector."""

from __future__ import annotations

import gc
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import torch

from cuda_ext.training.graphs import Watch, captured


class Recorder:
    """Stands in for the parts of `torch.cuda` that are used, and notes what is asked of them."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.stream = self._stream("here")
        self.fails_at_end: Exception | None = None

    def _stream(self, name):
        return SimpleNamespace(name=name, wait_stream=lambda other: self.asked.append(f"{name} waits for {other.name}"))

    def current_stream(self, device):
        return self.stream

    def Stream(self, device):
        return self._stream("aside")

    @contextmanager
    def in_stream(self, stream):
        before, self.stream = self.stream, stream
        try:
            yield
        finally:
            self.stream = before

    def CUDAGraph(self):
        def begin(capture_error_mode):
            self.asked.append(f"begin in {self.stream.name}, {capture_error_mode}")

        def end():
            self.asked.append(f"end in {self.stream.name}")
            if self.fails_at_end is not None:
                raise self.fails_at_end

        return SimpleNamespace(capture_begin=begin, capture_end=end, replay=lambda: self.asked.append("replay"))


@pytest.fixture
def cuda(monkeypatch):
    recorder = Recorder()
    for name in ("current_stream", "Stream", "CUDAGraph"):
        monkeypatch.setattr(torch.cuda, name, getattr(recorder, name))
    monkeypatch.setattr(torch.cuda, "stream", recorder.in_stream)
    return recorder


def test_a_step_is_captured_aside_and_replayed_where_it_is_asked_for(cuda):
    def launch():
        cuda.asked.append(f"launch in {cuda.stream.name}")

    again = captured(launch, torch.device("cuda"))
    assert cuda.asked == [
        "aside waits for here",
        "begin in aside, thread_local",
        "launch in aside",
        "end in aside",
        "here waits for aside",
    ]
    again()
    assert cuda.asked[-1] == "replay"


def test_no_older_graph_is_collected_while_one_is_captured(cuda):
    class Older:
        def __del__(self):
            cuda.asked.append("freed")

    older = Older()
    older.cycle = older
    del older
    was_on: list[bool] = []

    def launch():
        was_on.append(gc.isenabled())
        # enough new containers for the collector to start, if it were on
        [[] for _ in range(100_000)]

    gc.enable()
    captured(launch, torch.device("cuda"))
    assert was_on == [False]
    assert gc.isenabled()
    middle = cuda.asked[cuda.asked.index("begin in aside, thread_local") : cuda.asked.index("end in aside")]
    assert "freed" not in middle


def test_the_first_of_two_errors_is_told_with_what_to_do(cuda):
    cuda.fails_at_end = RuntimeError("operation failed due to a previous error during capture")

    def launch():
        raise RuntimeError("CUDA: cudaMalloc is not permitted when stream is capturing")

    with pytest.raises(RuntimeError, match=r"cannot be captured.*cudaMalloc is not permitted.*replay=False"):
        captured(launch, torch.device("cuda"))
    assert cuda.asked[-1] == "end in aside"
    assert gc.isenabled()
    assert cuda.stream.name == "here"


def test_flags_come_in_the_order_of_the_steps_and_no_copy_is_overwritten_before_it_is_read(monkeypatch):
    waited: list[int] = []

    class Event:
        def __init__(self):
            self.number = len(events)
            events.append(self)

        def record(self, stream):
            assert stream == "the state's"

        def synchronize(self):
            waited.append(self.number)

    events: list[Event] = []
    empty = torch.empty
    monkeypatch.setattr(torch, "empty", lambda shape, dtype, pin_memory: empty(shape, dtype=dtype))
    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: "the state's")
    state = torch.zeros(2, dtype=torch.int32)
    watch = Watch(state, 3)
    found = []
    for step in range(10):
        state.fill_(step)
        watch.post()
        if len(watch) == 3:
            with pytest.raises(RuntimeError, match="3 copies of the flags are on their way"):
                watch.post()
            found.append(watch.take()[0])
    while watch:
        found.append(watch.take()[0])
    assert found == list(range(10))
    assert waited == [k % 3 for k in range(10)]


@pytest.mark.parametrize(("reason", "first"), [(None, ["graph", "other"]), ("no GPU", ["other", "graph"])])
def test_graph_tests_go_first_where_there_is_a_gpu(monkeypatch, reason, first):
    import cuda_ext
    from tests.cuda.gpu.conftest import FOLDER, pytest_collection_modifyitems

    def item(name, folder=FOLDER):
        return SimpleNamespace(name=name, path=folder / "test.py", get_closest_marker=lambda kind: name == kind or None)

    monkeypatch.setattr(cuda_ext, "why_not", lambda: reason)
    items = [item("other"), item("graph"), item("graph", FOLDER.parent / "emulated")]
    emulated = items[2]
    pytest_collection_modifyitems(items)
    assert [each.name for each in items[:2]] == first
    assert items[2] is emulated
