"""Steps of several views on GPUs, each with Gaussians of its own, as Grendel (arXiv 2406.18533) shares a training out.

A process owns a stretch of the Gaussians: it projects them for every view of a step, and sends the splats that a view
shows to the process that draws it. What draws a view has all its splats in the order of their rows, so that lists and
sums are those of one process. Gradient sums and dominated pixels go back; the owner adds up the gradients of the views
in the order of the batch, moves its Gaussians by the mean, and keeps their statistics. Bits do not depend on how many
processes there are, since no two of them add to one number.

    for each view:      project own rows -> the splats that it shows                        68 bytes a splat, sent
    for own views:      lists, blend, loss, blend back
    for each view:      sums and dominated pixels, back                                     40 bytes a splat, sent
                        gradients of own rows, added up; with the last view Adam

A process holds the others' rows as these were when `synchronize` was last called.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import torch
from torch import Tensor

from cuda_ext import load
from cuda_ext.arrays import (
    BAD_ROW,
    N_IMPORTANT,
    N_INSTANCES,
    N_OTHERS,
    NOT_BAD,
    OVERFLOW,
    STEP,
    VIEW,
    pointer,
    stream_of,
)
from cuda_ext.render.lists import Capacity, Size
from cuda_ext.training.step_buffers import (
    FrameBuffers,
    KernelStatistics,
    ResidentViews,
    RowBuffers,
    Rows,
    Shared,
    SplatBuffers,
)
from cuda_ext.training.step_program import DrawProgram, gaussians, pop_term, regularizers, schedule, update, view_of

if TYPE_CHECKING:
    from pop_fast.train.ranks import Ranks
    from pop_fast.train.steps import Phase, StepSettings

# rows that a stretch is made of: a warp's, whose pieces of 16 bytes lie alike wherever it begins
STRETCH: Final = 32
# floats of a record, and of a row of sums, that three channels fill
_RECORD: Final = 10
_SUMS: Final = 9
# what is sent of a splat, and what comes back of it, floats: a record, depth, conic, extents and row; sums and a count
SENT: Final = _RECORD + 1 + 3 + 2 + 1
RETURNED: Final = _SUMS + 1
# the POP term and the regularizers are told as sums of whole numbers, which no order changes; scales have no bound
_POP_UNIT: Final = 2.0**30
_OWN_UNIT: Final = 2.0**20
# sides of the POP term, `PopSide` of csrc/polarization.cuh
_IMPORTANT, _OTHER = 1, 2


def stretches(n: int, size: int) -> list[int]:
    """Return where the rows of each of `size` processes begin, and where the last one's end."""
    warps = -(-n // STRETCH)
    return [min(STRETCH * (warps * rank // size), n) for rank in range(size + 1)]


def step_bytes(n: int, size: int, n_views: int, shown: float, steps: int, n_rest: int = 15) -> dict[str, float]:
    """Return how many bytes a process receives of the others in a step, where everything is spread evenly.

    Args:
        n: Gaussians.
        size: processes.
        n_views: of a step.
        shown: share of the Gaussians that a view shows.
        steps: between two calls of `synchronize`.
        n_rest: coefficients of colour above the first, three channels each.

    Returns:
        Bytes by the names of `BatchTrainer.received`.
    """
    of_others = (size - 1) / size
    # parameters and both moments; gradient sum, views, dominated pixels, blur
    row = 4 * 3 * (3 + 4 + 3 + 1 + 3 + 3 * n_rest) + 13
    crossing = shown * n * n_views / size * of_others
    return {"splats": 4 * SENT * crossing, "sums": 4 * RETURNED * crossing, "rows": row * n * of_others / steps}


@dataclass(frozen=True)
class _Place:
    """A view of a step as the owner of Gaussians sees it.

    Attributes:
        rows: own Gaussians, with what this view makes of them.
        packed: what is sent of the splats that it shows. [seen, SENT]
        seen: their rows among own ones. [seen]
    """

    rows: RowBuffers
    packed: Tensor
    seen: Tensor


class BatchTrainer:
    """Owns the device's side of training between two densification steps; see `train_step.FusedTrainer`.

    Args:
        params, m, v: raw parameters and Adam's moments, of all Gaussians; updated in place.
        views: the resident photographs and cameras.
        order: the views of every step of the schedule, `n_views` each.
        settings: objective and update.
        step: the step to begin at.
        n_views: of a step.
        ranks: the processes that train together.
    """

    def __init__(
        self,
        params: Rows,
        m: Rows,
        v: Rows,
        views: ResidentViews,
        order: Sequence[int],
        settings: StepSettings,
        step: int,
        n_views: int,
        ranks: Ranks,
    ) -> None:
        self.settings, self.views, self.step, self.grown = settings, views, step, 0
        self.device, self.n_views = params["means"].device, n_views
        self._order, self._ranks, self._capacity = list(order), ranks, Capacity(views.sizes)
        self._history: dict[int, list[float]] = {}
        # bytes that other processes have sent here, by what they are
        self.received = {"splats": 0, "sums": 0, "rows": 0}
        with torch.cuda.device_of(params["means"]):
            self._shared = Shared.make(settings, views, self._order, step, self.device)
        self._schedule = schedule(self._shared, n_views)
        self.rebind(params, m, v)

    def rebind(self, params: Rows, m: Rows, v: Rows) -> None:
        """Take new rows after a densification step: buffers and statistics start anew."""
        n = len(params["means"])
        self._programs: dict[tuple[Size, Phase], DrawProgram] = {}
        self._frames: dict[Size, FrameBuffers] = {}
        self._capacity.settle(n)
        self._bounds = stretches(n, self._ranks.size)
        self._first, last = self._bounds[self._ranks.rank : self._ranks.rank + 2]
        own = slice(self._first, last)
        with torch.cuda.device_of(params["means"]):
            waits = params["shN"].shape[1] if self.settings.updates.sh_rest_every > 1 else None
            self.statistics = KernelStatistics.zeros(n, self.device, waits)
            self._whole = [dict(group) for group in (params, m, v)]
            own_params, own_m, own_v = ({key: tensor[own] for key, tensor in group.items()} for group in self._whole)
            own_rows = RowBuffers.make(own_params, own_m, own_v, self.statistics.rows(own))
            self._of_place = [self._seen_by_a_view(own_rows) for _ in range(self.n_views)]
            self._counts = torch.zeros(len(own_rows), dtype=torch.int32, device=self.device)
            self._gradients = {key: torch.zeros_like(tensor) for key, tensor in own_params.items()}
            self._drawn = SplatBuffers.make(n, self.device)
        self._gaussians = gaussians(own_rows)

    def _seen_by_a_view(self, rows: RowBuffers) -> RowBuffers:
        """Return own rows with room for what a view keeps of them from its projection to its gradients."""
        s, drawn = rows.drawn.splats, rows.drawn
        kept = {name: torch.empty_like(s[name]) for name in ("conics", "opacities", "radii")}
        return replace(rows, drawn=replace(drawn, splats={**s, **kept}), pop_sides=torch.empty_like(rows.pop_sides))

    def run(self, until: int, phase: Phase) -> None:
        """Take steps until the counter stands at `until`, all of one phase; all processes do so together.

        Raises:
            ValueError: a Gaussian is no longer finite; the message names its row and step. Or the phase's degree has
                more coefficients than the Gaussians.
            CudaMemoryError: no room to grow.
        """
        with torch.cuda.device_of(self._shared.state):
            while self.step < until:
                bad = self._step(phase)
                if bad is not None:
                    self.synchronize()
                    raise ValueError(f"step {self.step}: Gaussian {bad} has a value that is not finite")

    def step_stats(self, first: int, last: int) -> list[list[float]]:
        """Return the measurements of the steps from `first` to before `last`: means over the views of each."""
        return [self._history[step] for step in range(first, last)]

    def facts(self) -> dict[str, int]:
        """Return how often buffers grew, how the photographs lie, and the bytes that other processes have sent."""
        told = {"instance_buffers_grown": self.grown, "received_bytes": sum(self.received.values())}
        return {**told, **self.views.facts()}

    def synchronize(self) -> None:
        """Give every process what the others have moved and counted."""
        tensors = [tensor for group in self._whole for tensor in group.values()]
        for tensor in (*tensors, *(found for found in vars(self.statistics).values() if found is not None)):
            self._ranks.share(tensor, self._bounds)
            self.received["rows"] += tensor.nbytes - tensor[: len(self._of_place[0])].nbytes

    def _step(self, phase: Phase) -> int | None:
        """Take a step, or return the row that is not finite."""
        views = self._order[self.step * self.n_views : (self.step + 1) * self.n_views]
        places = [self._projected(place, view, phase) for place, view in enumerate(views)]
        bad = int(self._shared.state[BAD_ROW])
        bad = NOT_BAD if bad == NOT_BAD else self._first + bad
        told = torch.stack(self._ranks.gather([torch.tensor([bad, *(len(of.seen) for of in places)])]))
        bad, counts = int(told[:, 0].min()), told[:, 1:].tolist()
        if bad != NOT_BAD:
            return bad
        arrived = self._sent_to_who_draws([of.packed for of in places], counts)
        drawn = [self._draw(place, views[place], rows, phase) for place, rows in arrived.items()]
        measured = torch.stack(self._ranks.gather([values for values, _ in drawn])).tolist()
        sums = self._sent_back([rows for _, rows in drawn], counts)
        terms = self._update(places, views, sums, phase)
        rows = [[*values[: len(values) - 1], term] for values, term in zip(measured, terms, strict=True)]
        self._history[self.step] = [sum(column) / len(rows) for column in zip(*rows, strict=True)]
        self.step += 1
        self._shared.state[STEP] = self.step
        return None

    def _begin(self, place: int) -> None:
        """Pick a view of the step: its camera, and nobody important yet."""
        self._schedule.place = place
        shared, stream = self._shared, stream_of(self.device)
        state = pointer("state", shared.state, "int32")
        load().begin_step(self._schedule, pointer("constants", shared.constants), state, stream)

    def _projected(self, place: int, view: int, phase: Phase) -> _Place:
        """Project own rows for a view."""
        shared, rows = self._shared, self._of_place[place]
        self._begin(place)
        if len(rows):
            camera = view_of(shared, self.views.sizes[view])
            how = shared.render(self.views.sizes[view], phase.sh_degree).project_settings()
            state = pointer("state", shared.state, "int32")
            load().project(self._gaussians, camera, how, rows.drawn.struct(), state, stream_of(self.device))
        s, records = rows.drawn.splats, rows.drawn.records
        seen = s["radii"][:, 0].gt(0).nonzero()[:, 0]
        numbers = (seen + self._first).to(torch.int32)
        whole = [number.view(torch.float32) for number in (s["radii"][seen], numbers[:, None])]
        parts = (records[seen, :_RECORD], s["depths"][seen, None], s["conics"][seen], *whole)
        return _Place(rows, torch.cat(parts, 1), seen)

    def _sent_to_who_draws(self, packed: Sequence[Tensor], counts: Sequence[Sequence[int]]) -> dict[int, Tensor]:
        """Exchange splats, and return those of own views by their place, in the order of their rows."""
        ranks, places = self._ranks, self._ranks.positions(self.n_views)
        share = len(places)
        sent = [torch.cat(list(packed[rank * share : (rank + 1) * share])) for rank in range(ranks.size)]
        received = ranks.exchange(sent, [sum(row[place] for place in places) for row in counts])
        self._note("splats", received)
        parts = [rows.split([row[place] for place in places]) for rows, row in zip(received, counts, strict=True)]
        return {place: torch.cat([part[k] for part in parts]) for k, place in enumerate(places)}

    def _sent_back(self, sums: Sequence[Tensor], counts: Sequence[Sequence[int]]) -> list[Tensor]:
        """Exchange sums, and return those of own rows by the place of their view."""
        ranks, places, mine = self._ranks, self._ranks.positions(self.n_views), counts[self._ranks.rank]
        by_owner = [rows.split([row[place] for row in counts]) for rows, place in zip(sums, places, strict=True)]
        sent = [torch.cat([parts[rank] for parts in by_owner]) for rank in range(ranks.size)]
        share = len(places)
        own = [mine[rank * share : (rank + 1) * share] for rank in range(ranks.size)]
        received = ranks.exchange(sent, [sum(lengths) for lengths in own])
        self._note("sums", received)
        return [part for rows, lengths in zip(received, own, strict=True) for part in rows.split(lengths)]

    def _note(self, what: str, received: Sequence[Tensor]) -> None:
        self.received[what] += sum(rows.nbytes for rank, rows in enumerate(received) if rank != self._ranks.rank)

    def _draw(self, place: int, view: int, rows: Tensor, phase: Phase) -> tuple[Tensor, Tensor]:
        """Draw a view and go back to sums; return what it measures and, in the order of the rows, what goes back."""
        at = rows[:, SENT - 1].contiguous().view(torch.int32).long()
        drawn, splats = self._drawn, self._drawn.splats
        drawn.records[at, :_RECORD] = rows[:, :_RECORD]
        splats["means2d"][at], splats["opacities"][at] = rows[:, :2], rows[:, 5]
        splats["depths"][at], splats["conics"][at] = rows[:, _RECORD], rows[:, _RECORD + 1 : _RECORD + 4]
        splats["radii"].zero_()
        splats["radii"][at] = rows[:, _RECORD + 4 : _RECORD + 6].contiguous().view(torch.int32)
        self.views.fetch(view)
        program = self._launched(place, self.views.sizes[view], phase)
        counts = torch.zeros(len(rows), device=self.device)
        if program.counts is not None:
            counts = program.counts[at].view(torch.float32)
        return self._shared.values.cpu().clone(), torch.cat((drawn.sums[at, :_SUMS], counts[:, None]), 1)

    def _launched(self, place: int, size: Size, phase: Phase) -> DrawProgram:
        """Launch a view's drawing, again where its instances did not fit."""
        state = self._shared.state
        while True:
            if size not in self._frames:
                room = self._capacity.room(size)
                self._frames[size] = FrameBuffers.make(self._shared, self._bounds[-1], size, room)
            if (size, phase) not in self._programs:
                self._programs[size, phase] = DrawProgram(self._shared, self._drawn, self._frames[size], phase)
            self._begin(place)
            self._programs[size, phase].launch()
            flags = state.tolist()
            if flags[OVERFLOW] == 0:
                self._capacity.note(flags[VIEW], flags[N_INSTANCES])
                return self._programs[size, phase]
            self.grown += 1
            self._capacity.overflowed(flags[VIEW], flags[OVERFLOW])
            self._programs = {key: program for key, program in self._programs.items() if key[0] != size}
            del self._frames[size]
            state[OVERFLOW] = 0

    def _update(
        self, places: Sequence[_Place], views: Sequence[int], sums: Sequence[Tensor], phase: Phase
    ) -> list[float]:
        """Move own rows by the mean of the views' gradients; return the weighted regularizers of every view."""
        # importance is settled for all views before the first one adds to the window
        own = torch.stack([self._sides(place, of, sums[place], phase) for place, of in enumerate(places)])
        totals = torch.stack(self._ranks.gather([own])).sum(0)
        state = self._shared.state
        for place, of in enumerate(places):
            self._begin(place)
            state[N_IMPORTANT], state[N_OTHERS] = totals[place, 0], totals[place, 1]
            self._take_counts(of, sums[place])
            of.rows.drawn.sums[of.seen, :_SUMS] = sums[place][:, :_SUMS]
            counts = self._counts if phase.dominance else None
            given = update(self._shared, of.rows, counts, phase, self._gradients, self._bounds[-1])
            given.n_views, given.place = self.n_views, place
            size = self.views.sizes[views[place]]
            camera, how = view_of(self._shared, size), self._shared.render(size, phase.sh_degree).project_settings()
            pointers = pointer("state", state, "int32"), stream_of(self.device)
            load().update(given, camera, how, of.rows.drawn.struct(), *pointers)
        weight = self.settings.lambda_pop / _POP_UNIT if phase.pop else 0.0
        own_weights = [w / _OWN_UNIT for w in regularizers(self.settings, phase, self._bounds[-1]).values()]
        return [
            weight * (a / max(n_a, 1) + b / max(n_b, 1)) + sum(w * c for w, c in zip(own_weights, own, strict=True))
            for n_a, n_b, a, b, *own in totals.tolist()
        ]

    def _take_counts(self, of: _Place, back: Tensor) -> None:
        self._counts.zero_()
        self._counts[of.seen] = back[:, _SUMS].contiguous().view(torch.int32)

    def _sides(self, place: int, of: _Place, back: Tensor, phase: Phase) -> Tensor:
        """Settle which of own rows are important in a view.

        Returns:
            How many are, how many are not, the terms of both, and the sums of the regularizers. [7]
        """
        weights = regularizers(self.settings, phase, self._bounds[-1]).values()
        own = _regularized(of.rows) if any(weights) else torch.zeros(3, dtype=torch.int64, device=self.device)
        if not phase.pop:
            return torch.cat((torch.zeros(4, dtype=torch.int64, device=self.device), own))
        self._begin(place)
        self._take_counts(of, back)
        state = self._shared.state
        term = pop_term(self._shared, of.rows, self._counts, phase)
        load().count_important(term, pointer("state", state, "int32"), stream_of(self.device))
        opacities, sides = torch.sigmoid(of.rows.params["opacities"].double()), of.rows.pop_sides[: len(of.rows)]
        terms = torch.stack(
            (torch.where(sides == _IMPORTANT, 1.0 - opacities, 0.0), torch.where(sides == _OTHER, opacities, 0.0))
        )
        whole = terms.mul(_POP_UNIT).round().long().sum(1)
        return torch.cat((state[[N_IMPORTANT, N_OTHERS]].long(), whole, own))


def _regularized(rows: RowBuffers) -> Tensor:
    """Sum what Gaussians add to the loss by themselves, without weights, in the order of `regularizers`. int64 [3]"""
    logits = rows.params["opacities"].double()
    opacities, softplus = torch.sigmoid(logits), torch.nn.functional.softplus
    entropies = opacities * softplus(-logits) + (1.0 - opacities) * softplus(logits)
    terms = (entropies, opacities, rows.params["scales"].double().exp().sum(1))
    return torch.stack([term.mul(_OWN_UNIT).round().long().sum() for term in terms])
