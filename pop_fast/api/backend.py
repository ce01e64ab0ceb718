"""What a backend is, and backends by name: those of this package, which `pop_fast.api` registers, and others'.

`rasterization` checks, gathers and makes `meta` for all of them; a backend supplies what is between. Stages take one
scene and one camera at a time, and are differentiable.

Another package declares its own under the entry point group `pop_splatting.backends`, or calls `BACKENDS.register`.
Which one runs is a value that is passed; nothing is patched, so two can be alive in one process and be compared in one
assertion. Asking which there are, and why one cannot run, imports no torch.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final, Protocol

from pop_fast.errors import PopError
from pop_ref.registry import Registry

if TYPE_CHECKING:
    from torch import Tensor

    from pop_fast.api.rasterize import RenderMeta
    from pop_fast.stages.compositing import Composite
    from pop_fast.stages.splatting import ProjectionSettings, Splats
    from pop_fast.stages.tiles import TileLists
    from pop_fast.train.steps import WholeStep


class ViewStages(Protocol):
    """Draws views."""

    def covariances(self, quats: Tensor, scales: Tensor) -> Any:
        """Return what `splats` takes as the shapes of Gaussians: covariances [N, 3, 3], or whatever a backend likes."""
        ...

    def splats(
        self,
        means: Tensor,
        shapes: Any,
        opacities: Tensor,
        colors: Tensor,
        viewmat: Tensor,
        settings: ProjectionSettings,
        sh_degree: int | None,
    ) -> Splats:
        """Return the Gaussians as one camera sees them, with colours.

        Args:
            means: centres, world units. [N, 3]
            shapes: from `covariances`, or covariances that were given. [N, 3, 3]
            opacities: in [0, 1]. [N]
            colors: any number of channels [N, D], or harmonics [N, n_sh, 3] when `sh_degree` is given.
            viewmat: world -> camera. [4, 4]
            settings: the rest of the camera.
            sh_degree: bands to evaluate, None for given colours.
        """
        ...

    def blend(
        self,
        rows: Splats,
        seen: Splats,
        settings: ProjectionSettings,
        tile_size: int,
        background: Tensor | None,
        *,
        dominance: bool,
        counts: bool,
        absgrad_sink: Tensor | None,
    ) -> Composite:
        """Blend the rows of one view over a background.

        Args:
            rows: what is blended: rows of `meta`, so that gradients pass through those; ids are places among them.
            seen: what `splats` returned for the view, of which `rows` are a part.
            settings: of the view.
            tile_size: px, the caller's; it has a meaning for visited entries, and in profile "inria".
            background: [D], or None for black.
            dominance: also find dominant ids and weights.
            counts: also count blended and visited entries.
            absgrad_sink: [M, 2], to which the transpose adds the sum over pixels of |dL/dmeans2d|.
        """
        ...

    def tile_lists(self, rows: Splats, settings: ProjectionSettings, tile_size: int) -> TileLists:
        """List every tile's rows by their extents alone, as gsplat's meta has them (D3, D4)."""
        ...

    def counts_entries(self, tile_size: int) -> bool:
        """Tell whether visited entries can be counted with tiles of that size."""
        ...


class Renderer(Protocol):
    """What draws for measurements, pages and tests."""

    @property
    def name(self) -> str:
        """Return the backend's name."""
        ...

    @property
    def device(self) -> Any:
        """Return where it draws, as `torch.device` takes it."""
        ...

    def available(self) -> bool:
        """Tell whether it can run here."""
        ...

    def why_not(self) -> str | None:
        """Return one sentence on why it cannot run here and what to do, or None."""
        ...

    def rasterization(self, *args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, RenderMeta]:
        """Render; see `pop_fast.api.rasterize.rasterization`."""
        ...


class Backend(Renderer, Protocol):
    """What renders and trains, by name; those of other packages stand in entry point group `pop_splatting.backends`."""

    @property
    def device(self) -> str:
        """Return where its tensors are, as `torch.device.type` says it."""
        ...

    @property
    def dtypes(self) -> tuple[str, ...]:
        """Return the types that its tensors may have, as torch calls them."""
        ...

    @property
    def speed(self) -> int | None:
        """Return a rank, by which "auto" takes the largest that can run; None is never taken."""
        ...

    @property
    def lacks(self) -> Mapping[str, tuple[Any, str]]:
        """Return arguments of `rasterization` that only this backend lacks: the one value each may have, and why."""
        ...

    def holds(self, tensor: Tensor) -> bool:
        """Tell whether a tensor is where this backend reads it."""
        ...

    def stages(self) -> ViewStages:
        """Return what draws."""
        ...

    def losses(self) -> Any:
        """Return the losses, in a module as `pop_fast.stages.losses`; a backend may leave them to that one."""
        ...

    def open_view(self, pass_input: Any) -> Any:
        """Project and list a `PassInput`; what comes back has the methods of `pop_fast.stages.stage_set.StagesView`."""
        ...

    def whole_step(self) -> WholeStep | None:
        """Return how it takes a whole training step by itself, or None: autograd over the stages takes them."""
        ...


BACKENDS: Final[Registry[Backend]] = Registry(
    "backend",
    "pop_splatting.backends",
    needs=("name", "device", "dtypes", "speed", "lacks", "why_not", "stages", "losses", "open_view", "whole_step"),
    error=PopError,
)


def backend_names() -> tuple[str, ...]:
    """Return the names that `get_backend` knows."""
    return tuple(BACKENDS)


def get_backend(name: str) -> Backend:
    """Return the backend of that name, if it can run here or not; PopError where none is, or not importable."""
    return BACKENDS.named(name)


def by_speed() -> Iterator[Backend]:
    """Give the backends that "auto" may take, the fastest first; one that cannot be imported is none."""
    found = [(backend.speed, backend) for _, backend in BACKENDS.usable() if backend.speed is not None]
    yield from (backend for _, backend in sorted(found, key=lambda pair: pair[0], reverse=True))


def fastest_backend(device: str) -> Backend:
    """Return the fastest backend for tensors on a kind of device that can run here.

    Args:
        device: as `torch.device.type` says it.

    Raises:
        PopError: none can; says why.
    """
    known = [backend for backend in by_speed() if backend.device == device]
    for backend in known:
        if backend.why_not() is None:
            return backend
    reasons = "; ".join(f"backend {b.name!r} cannot run: {b.why_not()}" for b in known)
    raise PopError(reasons or f"no backend renders tensors on {device!r}; move them to the CPU")


def require_backend(backend: str | Backend) -> Backend:
    """Return a backend, or that of a name, which can run here; PopError says why one cannot, and what to do."""
    found = get_backend(backend) if isinstance(backend, str) else backend
    if not callable(getattr(found, "why_not", None)):
        raise PopError(f"backend is {backend!r}; it must be a backend or the name of one")
    reason = found.why_not()
    if reason is not None:
        raise PopError(f"backend {found.name!r} cannot run: {reason}")
    return found
