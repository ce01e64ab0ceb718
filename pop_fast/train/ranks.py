"""Processes that train one model together: whose views are whose, and how what each has found is put together.

Every process holds all statistics and parameters, colours excepted, and takes every decision itself. On CPUs only the
drawing of a step's views is shared out, and all colours are held too; on GPUs (`cuda_ext.training.batch_step`) the
Gaussians are shared out within a block of steps, and colours and Adam's moments always are.
What is added up is added view by view in the order of the batch, wherever a view was drawn, so that the bits do not
depend on the number of processes. torch carries it: gloo between CPUs, NCCL between GPUs.
"""

from __future__ import annotations

import hashlib
import itertools
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import timedelta
from typing import Any, Final, TypeVar

import torch
from torch import Tensor

from pop_fast.errors import PopError
from pop_fast.train.choose import LAUNCHED, is_launched, local_rank
from pop_fast.train.signals import heard

T = TypeVar("T")

# what torchrun, and other launchers after it, tell a process of itself
# launchers start processes together; one that does not come in this time will not
_MEETING: Final = timedelta(minutes=10)
# rank 0 may load photographs, find cameras or measure held-out views for hours while the others wait
_PATIENCE: Final = timedelta(days=2)


class Ranks:
    """One process that trains by itself; `TorchRanks` is one of several."""

    rank: int = 0  # number of this process, from 0; the one that writes and prints is 0
    size: int = 1  # how many there are

    @property
    def writes(self) -> bool:
        """Tell whether this process is the one that writes and prints."""
        return self.rank == 0

    def positions(self, batch: int) -> range:
        """Return which views of a batch this process draws, by their place in it; `batch` is a multiple of `size`."""
        share = batch // self.size
        return range(self.rank * share, (self.rank + 1) * share)

    def gather(self, mine: Sequence[Tensor]) -> list[Tensor]:
        """Return the tensors of all views of a batch, in its order; all are of one shape and type."""
        return list(mine)

    def total(self, mine: Iterable[Tensor]) -> Tensor:
        """Return the sum over all views' vectors of a batch, added one after the other in its order. [P]"""
        parts = iter(mine)
        total = next(parts).clone()
        for part in parts:
            total += part
        return total

    def exchange(self, sent: Sequence[Tensor], received: Sequence[int]) -> list[Tensor]:
        """Send rows to every process, and return what every process has sent here.

        Args:
            sent: for each process. [rows, width] each
            received: how many rows come from each.
        """
        return list(sent)

    def share(self, whole: Tensor, bounds: Sequence[int]) -> None:
        """Give all processes, in place, the rows of a tensor that each of them holds.

        Args:
            whole: contiguous.
            bounds: the process `rank` holds the rows from `bounds[rank]` to before `bounds[rank + 1]`.
        """

    def any(self, flag: bool) -> bool:
        """Tell whether any process says so."""
        return flag

    def require_alike(self, begun_with: Mapping[str, str]) -> None:
        """Compare what the processes begin with, under the same names.

        Raises:
            PopError: they differ, as where each has a file system of its own; names the first that does.
        """

    def require_same(self, params: Mapping[str, Tensor], step: int) -> None:
        """Compare what the processes hold, bit by bit.

        Raises:
            PopError: they differ, as machines of different kinds or libraries may round otherwise.
        """

    def wait(self) -> None:
        """Wait until all processes are here."""

    def leave(self) -> None:
        """Take leave of the others."""


class TorchRanks(Ranks):
    """One of the processes of torch's default process group, which `join` makes; it waits for the others patiently."""

    def __init__(self) -> None:
        import torch.distributed

        self._torch: Any = torch.distributed
        self.rank, self.size = self._torch.get_rank(), self._torch.get_world_size()
        self._group = self._torch.new_group(timeout=_PATIENCE)

    def gather(self, mine: Sequence[Tensor]) -> list[Tensor]:
        sent = torch.stack(list(mine))
        received = [torch.empty_like(sent) for _ in range(self.size)]
        self._together(lambda: self._torch.all_gather(received, sent, self._group))
        return [one for part in received for one in part]

    def total(self, mine: Iterable[Tensor]) -> Tensor:
        """See `Ranks.total`: each process adds up its share of the entries over all views, and tells the others."""
        parts = torch.stack(list(mine))
        length, share = parts.shape[1], -(-parts.shape[1] // self.size)
        padded = torch.nn.functional.pad(parts, (0, share * self.size - length))
        sent = padded.reshape(len(parts), self.size, share).transpose(0, 1).contiguous()
        received = torch.empty_like(sent)
        self._together(lambda: self._torch.all_to_all_single(received, sent, group=self._group))
        added = super().total(received.reshape(-1, share))
        whole = [torch.empty_like(added) for _ in range(self.size)]
        self._together(lambda: self._torch.all_gather(whole, added, self._group))
        return torch.cat(whole)[:length]

    def exchange(self, sent: Sequence[Tensor], received: Sequence[int]) -> list[Tensor]:
        mine = torch.cat(list(sent))
        theirs = torch.empty((sum(received), *mine.shape[1:]), dtype=mine.dtype, device=mine.device)
        lengths = [len(rows) for rows in sent]
        self._together(lambda: self._torch.all_to_all_single(theirs, mine, list(received), lengths, self._group))
        return list(theirs.split(list(received)))

    def share(self, whole: Tensor, bounds: Sequence[int]) -> None:
        for rank, (first, last) in enumerate(itertools.pairwise(bounds)):
            if first < last:
                self._together(lambda rank=rank, rows=whole[first:last]: self._torch.broadcast(rows, rank, self._group))

    def any(self, flag: bool) -> bool:
        return any(bool(said) for said in self.gather([torch.tensor(flag)]))

    def require_alike(self, begun_with: Mapping[str, str]) -> None:
        for name, text in begun_with.items():
            if not self._alike(text.encode()):
                raise PopError(
                    f"the {self.size} processes have different {name}: start all with the same options, and let them "
                    "read the capture and the result folder from one file system"
                )

    def _alike(self, *parts: Any) -> bool:
        digest = hashlib.sha256()
        for part in parts:
            digest.update(part)
        found = self.gather([torch.frombuffer(bytearray(digest.digest()), dtype=torch.uint8)])
        return all(torch.equal(one, found[0]) for one in found)

    def require_same(self, params: Mapping[str, Tensor], step: int) -> None:
        if not self._alike(*(value.contiguous().numpy().data for value in params.values())):
            raise PopError(
                f"the {self.size} processes no longer hold the same Gaussians after {step} steps; the latest "
                "checkpoint is kept: use machines of one kind with the same versions and --threads"
            )

    def wait(self) -> None:
        self._together(lambda: self._torch.barrier(self._group))

    def leave(self) -> None:
        self._torch.destroy_process_group()

    def _together(self, call: Callable[[], T]) -> T:
        try:
            return call()
        except RuntimeError as error:
            raise PopError(
                f"process {self.rank} of {self.size} lost the others: one of them has ended, and its own message says "
                "why; the same command with --resume continues from the last checkpoint"
            ) from error


ALONE: Final = Ranks()


def join() -> Ranks:
    """Meet the other processes that were launched with this one, or return `ALONE` where there are none.

    Raises:
        PopError: what the launcher says is damaged, or the others cannot be reached.
    """
    if not is_launched():
        return ALONE
    import torch.distributed as group

    if not group.is_available():
        raise PopError("this torch was built without torch.distributed; start one process, or install another build")
    by_gpu = torch.cuda.is_available() and group.is_nccl_available()
    if local_rank() < torch.cuda.device_count():
        # before anything is put on a GPU; a rank without one of its own is refused where it needs one
        torch.cuda.set_device(local_rank())
    try:
        how = "cpu:gloo,cuda:nccl" if by_gpu else "gloo"
        heard(lambda: group.init_process_group(how, timeout=_MEETING))
        return TorchRanks()
    except (RuntimeError, ValueError) as error:
        given, why = ", ".join(f"{name}={os.environ[name]}" for name in LAUNCHED), str(error).partition("\n")[0]
        raise PopError(f"cannot connect to the other processes ({given}): {why}; start them with torchrun") from error
