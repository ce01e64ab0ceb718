"""Steps of several views on GPUs, each with Gaussians of its own, as Grendel (arXiv 2406.18533) shares a training out.

A process owns a stretch of the Gaussians: it projects them for every view of a step, and sends the splats that a view
shows to the process that draws it. That has them in the order of their rows, so that lists and sums are those of one
process. Gradient sums and dominated pixels go back; the owner adds up the gradients of the views in the order of the
batch, moves its Gaussians by the mean, and keeps their statistics. Bits do not depend on how many processes there are,
since no two of them add to one number.

    for each view:      project own rows -> the splats that it shows                        64 bytes a splat, sent
    for own views:      lists, blend, loss, blend back
    for each view:      sums and dominated pixels, back                                     40 bytes a splat, sent
                        gradients of own rows, added up; with the last view Adam

A process holds the others' rows as these were when `synchronize` was last called, but nobody else's colours and
moments. Where the Gaussians have changed, these go to those that own their rows now: 192 and 472 bytes each, sent. Most
density control reads no colours but copies them with their rows; numbers of rows tell what it has copied.
"""

from __future__ import annotations

import itertools
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
# what is sent of a splat, and what comes back of it, floats: a record, depth, conic and extents; sums and a count
SENT: Final = _RECORD + 1 + 3 + 2
RETURNED: Final = _SUMS + 1
# of the splats that a view shows, the room for more than it had: a fourth
_SPARE: Final = 4
# floats of a packed splat and of its row of sums, `RECORD` of csrc/launch.h
_ROW: Final = 12
# parameters that several processes keep of own Gaussians alone
_APART: Final = ("sh0", "shN")
# bytes of a Gaussian's statistics: gradient sum, views, dominated pixels, blur
_STATISTICS: Final = 13
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
        Bytes by the names of `BatchTrainer.received`; those of moments and colours are what a change that moves every
        row to another process would send. What process 0 collects for a file or a measurement is left out.
    """
    of_others, moves = (size - 1) / size, size > 1
    numbers, colors = _numbers(n_rest), 4 * _colors(n_rest)
    row, moments = 4 * numbers - colors + _STATISTICS, 2 * 4 * numbers
    crossing = shown * n * n_views / size * of_others
    return {
        "splats": 4 * SENT * crossing,
        "sums": 4 * RETURNED * crossing,
        "rows": row * n * of_others / steps,
        "moments": moments * n / size * moves / steps,
        "colors": colors * n / size * moves / steps,
    }


def held_bytes(n: int, size: int, n_views: int, shown: float, n_rest: int = 15) -> dict[str, float]:
    """Return how many bytes a process holds for Gaussians, where all is spread evenly; lists by tile come on top.

    Args:
        n, size, n_views, shown, n_rest: as `step_bytes` takes them.

    Returns:
        "whole": of all Gaussians, their parameters but for colours, and statistics. "drawn": of the splats of a view
        that it draws. "own": of its own Gaussians, colours, both moments, gradients, and what each view makes of them.
    """
    numbers, colors = _numbers(n_rest), 4 * _colors(n_rest)
    # packed splats and sums; means, depths, conics, opacities, extents
    splat = 2 * 4 * _ROW + 36
    # every view keeps its conics, opacities, extents and sides of the POP term; dominated pixels are counted
    own = 3 * 4 * numbers + colors + splat + (n_views - 1) * 25 + 1 + 4
    return {
        "whole": n * (4 * numbers - colors + _STATISTICS),
        "drawn": min(1.0, shown * (1.0 + 1.0 / _SPARE)) * n * splat,
        "own": own * n / size,
    }


def _numbers(n_rest: int) -> int:
    """Return how many numbers a Gaussian has."""
    return 3 + 4 + 3 + 1 + _colors(n_rest)


def _colors(n_rest: int) -> int:
    """Return how many of them are its colours."""
    return 3 + 3 * n_rest


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
        params: raw parameters of all Gaussians; updated in place, but for those that are kept `apart`.
        m, v: Adam's moments of all Gaussians, on any device, of which own ones are copied.
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
        # one process has all colours as its own, in the place of the parameters
        self.apart = _APART if ranks.size > 1 else ()
        self._apart: dict[str, Tensor] = {}
        # bytes that other processes have sent here, by what they are
        self.received = {"splats": 0, "sums": 0, "rows": 0, "moments": 0, "colors": 0}
        with torch.cuda.device_of(params["means"]):
            self._shared = Shared.make(settings, views, self._order, step, self.device)
        self._schedule = schedule(self._shared, n_views)
        self.rebind(params, m, v)

    def rebind(self, params: Rows, m: Rows, v: Rows) -> None:
        """Take new rows, and own ones of their moments: buffers and statistics start anew."""
        self._programs: dict[tuple[Size, Phase], DrawProgram] = {}
        self._frames: dict[Size, FrameBuffers] = {}
        self._drawn: SplatBuffers | None = None
        own = self._own(stretches(len(params["means"]), self._ranks.size))
        apart = {key: self._own_rows(key, params[key]) for key in self.apart}
        self._bind(params, apart, *({key: of[key][own].to(self.device, copy=True) for key in of} for of in (m, v)))

    def regroup(self, params: Rows, origins: Rows) -> None:
        """Take new rows after a densification step, and own ones' moments from those that had the rows before it.

        Args:
            params: raw parameters of all Gaussians. In place of one of those that are kept `apart` there may be the
                former place of each row, from 1, which these rows are copied from. [N]
            origins: for each parameter the former place of each row, from 1, or 0 for moments of zero. int32 [N]
        """
        # what the old number of Gaussians needed goes first; moments of one parameter at a time are there twice
        self._of_place, self._programs, self._frames, self._drawn, self._gradients = [], {}, {}, None, {}
        apart = {key: self._own_rows(key, params[key]) for key in self.apart}
        moved = {key: self._moved("moments", [of.pop(key) for of in self._moments], origins[key]) for key in params}
        self._bind(params, apart, *({key: of[place] for key, of in moved.items()} for place in (0, 1)))

    def _own(self, bounds: Sequence[int]) -> slice:
        return slice(*bounds[self._ranks.rank : self._ranks.rank + 2])

    def _own_rows(self, key: str, rows: Tensor) -> Tensor:
        """Return own rows of what is kept apart: of all rows, or from those that had what their numbers say."""
        if rows.dim() > 1:
            return rows[self._own(stretches(len(rows), self._ranks.size))].clone()
        return self._moved("colors", [self._apart.pop(key)], rows)[0]

    def _bind(self, params: Rows, apart: dict[str, Tensor], m: Rows, v: Rows) -> None:
        n = len(params["means"])
        self._capacity.settle(n)
        self._bounds = stretches(n, self._ranks.size)
        own = self._own(self._bounds)
        self._first = own.start
        with torch.cuda.device_of(params["means"]):
            self._whole = {key: tensor for key, tensor in params.items() if key not in apart}
            self._apart, self._moments = apart, (dict(m), dict(v))
            own_params = {key: apart[key] if key in apart else tensor[own] for key, tensor in params.items()}
            waits = own_params["shN"].shape[1] if self.settings.updates.sh_rest_every > 1 else None
            self.statistics = KernelStatistics.zeros(n, self.device, waits)
            own_rows = RowBuffers.make(own_params, *self._moments, self.statistics.rows(own))
            self._of_place = [self._seen_by_a_view(own_rows) for _ in range(self.n_views)]
            self._counts = torch.zeros(len(own_rows), dtype=torch.int32, device=self.device)
            self._gradients = {key: torch.zeros_like(tensor) for key, tensor in own_params.items()}
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
        """Give every process what the others have moved and counted, but for moments and what is kept `apart`."""
        found = (*self._whole.values(), *vars(self.statistics).values())
        for tensor in (tensor for tensor in found if tensor is not None):
            self._ranks.share(tensor, self._bounds)
            self.received["rows"] += tensor.nbytes - tensor[: len(self._of_place[0])].nbytes

    def moments(self) -> dict[str, dict[str, Tensor]]:
        """Return all Gaussians' moments by parameter and torch's names, on the CPU, at process 0; empty ones elsewhere.

        One tensor after the other passes through the GPU of process 0.
        """
        m, v = self._moments
        return {key: {"exp_avg": self._at_first(m[key]).cpu(), "exp_avg_sq": self._at_first(v[key]).cpu()} for key in m}

    def whole(self, everywhere: bool) -> dict[str, Tensor]:
        """Return all Gaussians' rows of what is kept `apart`, at every process or at process 0; none elsewhere."""
        found = {key: (self._at_all if everywhere else self._at_first)(own) for key, own in self._apart.items()}
        if not everywhere and not self._ranks.writes:
            return {}
        self.received["colors"] += sum(rows.nbytes - self._apart[key].nbytes for key, rows in found.items())
        return found

    def _at_first(self, own: Tensor) -> Tensor:
        """Return the rows of all processes at process 0, none elsewhere."""
        ranks, lengths = self._ranks, [high - low for low, high in itertools.pairwise(self._bounds)]
        sent = [own, *[own[:0]] * (ranks.size - 1)]
        return torch.cat(ranks.exchange(sent, lengths if ranks.writes else [0] * ranks.size))

    def _at_all(self, own: Tensor) -> Tensor:
        """Return the rows of all processes at each of them."""
        found = own.new_empty((self._bounds[-1], *own.shape[1:]))
        found[self._own(self._bounds)] = own
        self._ranks.share(found, self._bounds)
        return found

    def _moved(self, what: str, held: Sequence[Tensor], origins: Tensor) -> list[Tensor]:
        """Return tensors of own rows as they will be, having sent the others theirs.

        Args:
            what: they are, by the names of `received`.
            held: tensors of own rows as they were.
            origins: of all rows the former place, from 1, or 0 for zeros. [N]
        """
        ranks, former = self._ranks, self._bounds
        bounds = stretches(len(origins), ranks.size)
        wanted = [origins[first:last] for first, last in itertools.pairwise(bounds)]

        def held_by(rank: int, rows: Tensor) -> Tensor:
            return (rows > former[rank]) & (rows <= former[rank + 1])

        places = [(rows[held_by(ranks.rank, rows)] - 1 - former[ranks.rank]).long() for rows in wanted]
        own = wanted[ranks.rank]
        comes = [held_by(rank, own) for rank in range(ranks.size)]
        lengths = [int(mask.sum()) for mask in comes]
        moved = []
        for tensor in held:
            received = ranks.exchange([tensor[rows] for rows in places], lengths)
            self._note(what, received)
            there = tensor.new_zeros((len(own), *tensor.shape[1:]))
            for mask, rows in zip(comes, received, strict=True):
                there[mask] = rows
            moved.append(there)
        return moved

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
        extents = s["radii"][seen].view(torch.float32)
        parts = (records[seen, :_RECORD], s["depths"][seen, None], s["conics"][seen], extents)
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
        k, drawn = len(rows), self._room(len(rows))
        splats = drawn.splats
        drawn.records[:k, :_RECORD] = rows[:, :_RECORD]
        splats["means2d"][:k], splats["opacities"][:k] = rows[:, :2], rows[:, 5]
        splats["depths"][:k], splats["conics"][:k] = rows[:, _RECORD], rows[:, _RECORD + 1 : _RECORD + 4]
        splats["radii"][:k] = rows[:, _RECORD + 4 : SENT].contiguous().view(torch.int32)
        splats["radii"][k:] = 0
        self.views.fetch(view)
        program = self._launched(place, self.views.sizes[view], phase, drawn)
        counts = torch.zeros(k, device=self.device)
        if program.counts is not None:
            counts = program.counts[:k].view(torch.float32)
        return self._shared.values.cpu().clone(), torch.cat((drawn.sums[:k, :_SUMS], counts[:, None]), 1)

    def _room(self, k: int) -> SplatBuffers:
        """Return room for the splats of a view; what was made for fewer goes, with all that holds its addresses."""
        if self._drawn is None or k > len(self._drawn.splats["radii"]):
            self._programs, self._frames, self._drawn = {}, {}, None
            self._drawn = SplatBuffers.make(min(k + k // _SPARE, self._bounds[-1]), self.device)
        return self._drawn

    def _launched(self, place: int, size: Size, phase: Phase, drawn: SplatBuffers) -> DrawProgram:
        """Launch a view's drawing, again where its instances did not fit."""
        state = self._shared.state
        while True:
            if size not in self._frames:
                n, room = len(drawn.splats["radii"]), self._capacity.room(size)
                self._frames[size] = FrameBuffers.make(self._shared, n, size, room)
            if (size, phase) not in self._programs:
                self._programs[size, phase] = DrawProgram(self._shared, drawn, self._frames[size], phase)
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
