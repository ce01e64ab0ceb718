"""The compiled stages' own promises; the laws judge their numbers.

Sixteen numbers side by side are the same numbers, however wide the processor's vectors are; and so is a training.
"""

from __future__ import annotations

import mmap
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import dedent

import pytest
import torch
from torch import Tensor

from cuda_ext.toolkit import find_compiler
from pop_fast import compiled
from pop_fast.api.backend import get_backend
from pop_fast.api.checks import check_sizes
from pop_fast.compiled import build as building
from pop_fast.compiled import compositing as in_cpp
from pop_fast.compiled import library, losses
from pop_fast.compiled.compositing import composite as native
from pop_fast.density.passes import Passes
from pop_fast.stages import splatting
from pop_fast.stages.compositing import Composite
from pop_fast.stages.compositing import composite as composite_in_torch
from pop_fast.stages.contributions import sensitivities
from pop_fast.stages.splatting import ProjectionSettings
from pop_fast.stages.splatting import Splats as Rows
from pop_fast.stages.tiles import TileLists, tile_lists
from pop_fast.train import TrainingRun
from pop_ref.constants import INRIA, PAPER, PROFILES, Profile
from tests.app.tiny import last_checkpoint, tiny_capture, tiny_config
from tests.fast.test_passes import raw_params, views

pytestmark = pytest.mark.skipif(not compiled.available(), reason=compiled.why_not() or "")

WIDTH, HEIGHT = 45, 38


@dataclass(frozen=True)
class Splats:
    """What a blend takes, and the lists of one tile size."""

    means2d: Tensor
    conics: Tensor
    opacities: Tensor
    colors: Tensor
    lists: TileLists

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.means2d, self.conics, self.opacities, self.colors


def splats(tile_size: int = 8, channels: int = 3, n: int = 120, dtype: torch.dtype = torch.float64) -> Splats:
    """Draw splats of which some are opaque, some invisible, some larger than a tile and some off the screen."""
    generator = torch.Generator().manual_seed(7)

    def uniform(*size: int) -> Tensor:
        return torch.rand(size, generator=generator, dtype=torch.float64)

    means2d = uniform(n, 2) * torch.tensor([WIDTH + 16.0, HEIGHT + 16.0]) - 8.0
    sigma = 0.6 + 7.0 * uniform(n, 2) ** 3
    turn = (1.8 * uniform(n) - 0.9) / sigma.prod(1)
    conics = torch.stack((1.0 / sigma[:, 0] ** 2, turn, 1.0 / sigma[:, 1] ** 2), 1)
    opacities = uniform(n)
    opacities[:8], opacities[8:16] = 1.0, 0.0
    radii = torch.ceil(4.0 * sigma.amax(1, keepdim=True).expand(n, 2) * 2.3).to(torch.int32)
    drawn = [tensor.to(dtype) for tensor in (means2d, conics, opacities, uniform(n, channels))]
    lists = tile_lists(drawn[0], radii, uniform(n).to(dtype), WIDTH, HEIGHT, tile_size)
    return Splats(*drawn, lists)


def blended(given: Splats, profile: Profile = PAPER, sink: Tensor | None = None) -> tuple[Composite, list[Tensor]]:
    """Blend with every extra, and pull a cotangent back."""
    leaves = [tensor.clone().requires_grad_() for tensor in given.tensors]
    found = native(*leaves, given.lists, WIDTH, HEIGHT, profile, dominance=True, counts=True, absgrad_sink=sink)
    generator = torch.Generator().manual_seed(11)
    v_image = torch.randn(found.image.shape, generator=generator, dtype=torch.float64).to(found.image.dtype)
    v_alphas = torch.randn(found.alphas.shape, generator=generator, dtype=torch.float64).to(found.image.dtype)
    ((found.image * v_image).sum() + (found.alphas * v_alphas).sum()).backward()
    return found, [leaf.grad for leaf in leaves]


def as_splats(drawn: Splats) -> Rows:
    n, dtype = len(drawn.means2d), drawn.means2d.dtype
    radii = torch.ones((n, 2), dtype=torch.int32)
    return Rows(drawn.means2d, torch.zeros(n, dtype=dtype), drawn.conics, drawn.opacities, radii, None, drawn.colors)


def passes_native() -> tuple[Callable, Callable, Callable]:
    stages = get_backend("compiled").stages()
    return stages.contributions, stages.sensitivities, stages.screen_moments


CEILINGS = (PAPER, replace(INRIA, alpha_ceiling=0.7))


def assert_alike(found: Callable[[], Sequence[Tensor]], numbers: Sequence[int] = (2, 3, 7)) -> None:
    """Assert that so many threads give the bits of one."""
    torch.set_num_threads(1)
    first = found()
    for number in numbers:
        torch.set_num_threads(number)
        assert all(torch.equal(a, b) for a, b in zip(first, found(), strict=True)), number


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_bits_do_not_depend_on_the_number_of_threads(dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    given = splats(n=400, dtype=dtype)

    def made() -> list[Tensor]:
        found, gradients = blended(given)
        return [found.image.detach(), found.alphas.detach(), found.dominant_ids, *gradients]

    assert_alike(made)
    with_torchs = made()
    # threads of its own
    without_torchs = replace(library.this_library(), fork=None)
    monkeypatch.setattr(library, "this_library", lambda: without_torchs)
    assert all(torch.equal(a, b) for a, b in zip(with_torchs, made(), strict=True))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the limit on memory is Linux's")
def test_running_out_of_memory_is_an_error_and_not_the_end(tmp_path: Path) -> None:
    program = """
        import resource, torch
        from pop_fast.api.rasterize import rasterization

        def render(tile_size):
            means, quats = torch.tensor([[0.0, 0.0, 4.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
            Ks = torch.tensor([[[20.0, 0.0, 8.0], [0.0, 20.0, 8.0], [0.0, 0.0, 1.0]]])
            splat = (means, quats, torch.ones(1, 3), torch.ones(1), torch.ones(1, 3))
            extras = {"tile_size": tile_size, "counts": True, "backend": "compiled"}
            return rasterization(*splat, torch.eye(4)[None], Ks, 16, 16, **extras)

        render(16)
        used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + 2**28, used + 2**28))
        try:
            render(4096)
        except (MemoryError, RuntimeError) as error:
            print(type(error).__name__, bool(render(16)[0].any()))
    """
    done = subprocess.run([sys.executable, "-c", dedent(program)], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "MemoryError True\n"


def test_what_is_kept_for_the_transpose_goes_with_it() -> None:
    given = splats(n=400)
    leaf = given.opacities.clone().requires_grad_()
    found = native(given.means2d, given.conics, leaf, given.colors, given.lists, WIDTH, HEIGHT)
    node = found.image.grad_fn
    names = [name for name in node.kept if name == "transmittances"]
    assert names == ["transmittances"]
    assert not any(isinstance(value, Tensor) for value in vars(node).values())
    found.image.sum().backward()
    with pytest.raises(RuntimeError, match="after they have already been freed"):
        _ = node.saved_tensors


def test_a_tile_that_no_memory_holds_is_refused() -> None:
    with pytest.raises(ValueError, match="tile_size is 65536; it must be <= 4096"):
        check_sizes(16, 16, 65536)


@pytest.mark.parametrize("lists", ["fast", "compiled"])
def test_a_splat_whose_conic_vanished_is_listed_everywhere(lists: str) -> None:
    listing = get_backend(lists).stages().list_tiles
    conics, radii = torch.zeros(1, 3), torch.full((1, 2), 10**6, dtype=torch.int32)
    shape = {"conics": conics, "opacities": torch.tensor([0.5])}
    found = listing(torch.zeros(1, 2), radii, torch.ones(1), WIDTH, HEIGHT, 16, PAPER, **shape)
    assert found.lengths.tolist() == [1] * 9


def test_nothing_to_blend_is_black() -> None:
    given = splats()
    empty = replace(given, lists=replace(given.lists, ids=given.lists.ids[:0], offsets=given.lists.offsets * 0))
    found, gradients = blended(empty)
    assert not found.image.any()
    assert not found.alphas.any()
    assert found.n_pairs == 0
    assert bool((found.dominant_ids == -1).all())
    assert not any(v.any() for v in gradients)


def test_pairs_are_counted_where_pixels_are_lit() -> None:
    few = splats(8, n=30)
    faint = replace(few, opacities=0.01 * few.opacities)
    found, _ = blended(faint)
    # nothing stops, so that every entry meets every row of its tile that lies in the image, eight pixels at a time
    rows = [min(8, HEIGHT - 8 * (tile // faint.lists.tiles_x)) for tile in range(len(faint.lists.lengths))]
    assert found.n_pairs == sum(8 * n * length for n, length in zip(rows, faint.lists.lengths.tolist(), strict=True))
    dense = splats(8, n=900)
    stopped, _ = blended(dense)
    assert 0 < stopped.n_pairs < len(dense.lists.ids) * 64


@pytest.mark.parametrize("profile", PROFILES)
def test_any_number_of_threads_gives_the_same_bits(profile: str) -> None:
    params = raw_params(400, torch.float32)
    pixel_map = torch.rand(22, 37, generator=torch.Generator().manual_seed(9))

    def found() -> list[Tensor]:
        made = Passes("compiled", views(torch.float32), profile, (0.1, 0.2, 0.3))
        all_sums = made.contributions(params, 0, 3, pixel_map)
        names = ("weight_sum", "n_pixels", "map_sum", "distance_sum", "dominant_counts", "image")
        rest = [made.sensitivities(params, 0, 3), made._open(made._shot(params, 0, 3))._moments()]
        return [*(getattr(all_sums, name) for name in names), *rest, *made.dominant_points(params, 0, 3)]

    assert_alike(found)


def test_an_empty_view_sums_to_nothing() -> None:
    nothing = TileLists(torch.zeros(0, dtype=torch.int32), torch.zeros(10, dtype=torch.int64), 16, 3, 3)
    of_view, black = (as_splats(splats(16)), nothing, WIDTH, HEIGHT, 16), torch.zeros(3, dtype=torch.float64)
    contributions, sensitivities, screen_moments = passes_native()
    of_map = contributions(*of_view, torch.ones(HEIGHT, WIDTH, dtype=torch.float64), PAPER)
    sums = [getattr(of_map, name) for name in ("weight_sum", "n_pixels", "map_sum", "distance_sum")]
    for total in (*sums, sensitivities(*of_view, black, PAPER), screen_moments(*of_view, black, PAPER)):
        assert not bool(total.any())


def test_lists_of_another_grid_are_refused() -> None:
    drawn = splats(16)
    for stage in passes_native():
        with pytest.raises(ValueError, match="45 x 38 px in tiles of 8 px are 6 x 5"):
            stage(as_splats(drawn), drawn.lists, WIDTH, HEIGHT, 8)


def test_moments_take_three_channels() -> None:
    drawn = splats(16, channels=2)
    with pytest.raises(ValueError, match="2 colour channels"):
        passes_native()[2](as_splats(drawn), drawn.lists, WIDTH, HEIGHT, 16)


@pytest.mark.parametrize("channels", [1, 2, 5])
def test_sensitivities_take_any_number_of_channels(channels: int) -> None:
    drawn = splats(16, channels=channels)
    background = torch.linspace(0.1, 0.5, channels, dtype=torch.float64)
    of_view = (as_splats(drawn), drawn.lists, WIDTH, HEIGHT, 16, background)
    torch.testing.assert_close(passes_native()[1](*of_view), sensitivities(*of_view), rtol=1e-12, atol=1e-14)
    with pytest.raises(ValueError, match="background has shape"):
        passes_native()[1](*of_view[:-1], torch.zeros(channels + 1, dtype=torch.float64))


def test_the_gradients_of_a_projection_do_not_depend_on_the_number_of_threads() -> None:
    generator, n = torch.Generator().manual_seed(1), 3000

    def normal(*size: int) -> Tensor:
        return torch.randn(size, generator=generator, dtype=torch.float64)

    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[2, 3] = torch.linalg.qr(normal(3, 3)).Q, 3.0
    inputs = [2.0 * normal(n, 3), normal(n, 4), torch.exp(normal(n, 3) - 2.0), torch.sigmoid(normal(n)), viewmat]
    means, quats, scales, opacities, viewmat = leaves = [tensor.requires_grad_() for tensor in inputs]
    K = torch.tensor([[40.0, 0.0, 21.0], [0.0, 37.0, 20.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    view = ProjectionSettings(K, WIDTH, HEIGHT, PAPER, antialiased=True)

    def found() -> Sequence[Tensor]:
        splats = in_cpp.project(means, in_cpp.covariances(quats, scales), opacities, viewmat, view)
        return torch.autograd.grad(splats.means2d.sum() + splats.conics.sum() + splats.opacities.sum(), leaves)

    assert_alike(found, (2, 5))


@pytest.mark.parametrize("shown", [[], [0], [6], [2, 3]])
def test_gradients_of_unseen_gaussians_are_zero(shown: list[int]) -> None:
    sh, means = torch.ones(7, 4, 3, requires_grad=True), torch.rand(7, 3, requires_grad=True)
    colors = in_cpp.colors_of_view(sh, means, torch.eye(4), 1, torch.tensor(shown, dtype=torch.int64))
    v_sh, v_means = torch.autograd.grad(colors.sum(), (sh, means))
    assert v_sh.flatten(1).any(1).nonzero().squeeze(1).tolist() == shown
    assert set(v_means.any(1).nonzero().squeeze(1).tolist()) <= set(shown)
    assert bool(v_means.isfinite().all())


MASK = torch.tensor([True, False, True])


@pytest.mark.parametrize(
    ("visible", "words"),
    [
        (MASK, r"is a tensor of torch.bool and shape \[3\]; .* of a mask these are mask.nonzero\(\).squeeze\(1\)"),
        (MASK.nonzero(), r"shape \[2, 1\]; it must hold the numbers of the rows to evaluate, torch.int64 \[V\]"),
        (torch.tensor([0, 2], dtype=torch.int32), "visible is a tensor of torch.int32"),
        (torch.tensor([0, 3]), "visible names row 0 to 3; there are 3"),
        (torch.tensor([-1, 2]), "visible names row -1 to 2; there are 3"),
        (torch.tensor([2, 0]), "ascending order, each once; use visible.unique()"),
        (torch.tensor([1, 1]), "ascending order, each once; use visible.unique()"),
    ],
    ids=["mask", "columns", "int32", "beyond", "negative", "descending", "twice"],
)
def test_rows_that_are_none_are_refused_before_they_are_read(visible: Tensor, words: str) -> None:
    sh, means = torch.ones(3, 4, 3), torch.ones(3, 3)
    with pytest.raises(ValueError, match=words):
        in_cpp.colors_of_view(sh, means, torch.eye(4), 1, visible)
    shown = in_cpp.colors_of_view(sh, means, torch.eye(4), 1, MASK.nonzero().squeeze(1))
    assert (shown != 0.0).any(1).tolist() == MASK.tolist()


def test_a_file_whose_name_is_no_text_does_not_hide_the_threads_of_torch(tmp_path: Path) -> None:
    name = os.fsencode(tmp_path) + b"/\xff"
    with open(name, "w+b") as file:
        file.write(bytes(mmap.PAGESIZE))
        file.flush()
        with mmap.mmap(file.fileno(), 0):
            assert (library._fork() is None) == (library.this_library().fork is None)


def test_bands_that_are_not_there_are_not_read() -> None:
    rows = (torch.ones(3, 4, 3), torch.ones(3, 3), torch.eye(4))
    for stage in (splatting.colors_of_view, in_cpp.colors_of_view):
        for degree, words in ((2, "sh has 4 coefficients; degree 2 needs 9"), (4, "it must be 0, 1, 2 or 3")):
            with pytest.raises(ValueError, match=words):
                stage(*rows, degree, torch.arange(3))


@pytest.mark.parametrize("blend", [native, composite_in_torch])
def test_lists_of_another_size_of_image_are_refused(blend: Callable[..., Composite]) -> None:
    drawn = splats()
    with pytest.raises(ValueError, match="the lists are of 6 x 5 tiles of 8 px; 90 x 38 px in tiles of 8 px are 12 x"):
        blend(*drawn.tensors, drawn.lists, 2 * WIDTH, HEIGHT)


LEVELS = [level for level, _ in building.LEVELS["x86_64"]]
# every primitive of lanes.h against the same thing said number by number; prints what differs
PROGRAM = r"""
#include <cstdio>
#include <limits>
#include <random>
#include "pop_fast/compiled/ssim.h"
using namespace pop;

static int wrong = 0;
static void same(const char *what, double found, double asked) {
  if (!(found == asked || (found != found && asked != asked))) {
    std::printf("%s is %.17g, not %.17g\n", what, found, asked);
    wrong++;
  }
}

template <class Real> Real halved(const Real *v, int n) {
  if (n == 1) return v[0];
  Real halves[LANES<Real>];
  for (int i = 0; i < n / 2; i++) halves[i] = v[i] + v[i + n / 2];
  return halved(halves, n / 2);
}

template <class Real> void judge(std::mt19937 &random) {
  constexpr int n = LANES<Real>;
  std::uniform_real_distribution<double> anywhere(-40.0, 40.0);
  using Limits = std::numeric_limits<Real>;
  const Real odd[] = {Real(0), Real(-0.0), Limits::quiet_NaN(), Limits::infinity()};
  Real a[n], b[n], c[n], rows[16 * n], sums[16];
  Whole<Real> places[n];
  for (int i = 0; i < n; i++) {
    a[i] = random() % 8 ? Real(anywhere(random)) : odd[random() % 4];
    b[i] = random() % 4 ? Real(anywhere(random)) : a[i];
    c[i] = Real(anywhere(random));
    places[i] = Whole<Real>(random() % 1000) - 500;
  }
  for (Real &value : rows) value = Real(anywhere(random));
  const Vec<Real> u = load(a), v = load(b), w = load(c);
  const Mask<Real> whole = load_whole<Real>(places);
  const Real bound = b[0];
  uint32_t under = 0, over = 0;
  for (int i = 0; i < n; i++) {
    same("u + v", (u + v)[i], Real(a[i] + b[i]));
    same("u - bound", (u - bound)[i], Real(a[i] - bound));
    same("bound * u", (bound * u)[i], Real(bound * a[i]));
    same("u / v", (u / v)[i], Real(a[i] / b[i]));
    same("-u", (-u)[i], -a[i]);
#ifdef __FMA__
    same("fma", fma(u, v, w)[i], std::fma(a[i], b[i], c[i]));
    same("fms", fms(u, v, w)[i], std::fma(a[i], b[i], -c[i]));
    same("fnma", fnma(u, v, w)[i], std::fma(-a[i], b[i], c[i]));
#else
    same("fma", fma(u, v, w)[i], Real(a[i] * b[i]) + c[i]);
    same("fms", fms(u, v, w)[i], Real(a[i] * b[i]) - c[i]);
    same("fnma", fnma(u, v, w)[i], c[i] - Real(a[i] * b[i]));
#endif
    same("u < v", (u < v)[i], a[i] < b[i] ? -1 : 0);
    same("u > bound", (u > bound)[i], a[i] > bound ? -1 : 0);
    same("u >= v", (u >= v)[i], a[i] >= b[i] ? -1 : 0);
    same("u <= bound", (u <= bound)[i], a[i] <= bound ? -1 : 0);
    same("select", select(u < v, u, v)[i], a[i] < b[i] ? a[i] : b[i]);
    same("least", least(u, v)[i], a[i] < b[i] ? a[i] : b[i]);
    same("most", most(u, v)[i], a[i] > b[i] ? a[i] : b[i]);
    same("size_of", size_of(u)[i], std::abs(a[i]));
    same("select of whole numbers", select(u < v, whole, Mask<Real>{})[i], a[i] < b[i] ? places[i] : 0);
    under |= uint32_t(a[i] < b[i]) << i;
    over |= uint32_t(a[i] < b[i] && b[i] > bound) << i;
  }
  same("lanes_of", lanes_of<Real>(u < v), under);
  same("lanes_of of both", lanes_of<Real>((u < v) & (v > bound)), over);
  same("any", any(u < v), under != 0);
  same("none", any(u < u), 0);
  for (int i = 0; i < n; i++) {
    Real one[n] = {};
    one[i] = Real(1);
    same("any of one", any(load(one) > Real(0)), 1);
    same("lanes_of of one", lanes_of<Real>(load(one) > Real(0)), uint32_t(1) << i);
  }
  sums_of_rows(rows, sums);
  for (int k = 0; k < 16; k++) {
    same("sum", sum<Real>(load(rows + k * n)), halved(rows + k * n, n));
    same("sums_of_rows", sums[k], halved(rows + k * n, n));
  }
  const Vec<double> wide = widened(load(rows));
  for (int i = 0; i < LANES<double>; i++)
    same("widened", wide[i], n == 8 ? double(rows[i]) : double(rows[i]) + double(rows[(i + 8) % n]));
  Vec<Real> e = load(rows);
  for (int i = 0; i < n; i++) {
    const double found = exp2_of<Real>(e)[i], asked = std::exp2(double(rows[i]));
    if (!(std::abs(found - asked) <= 3e-7 * asked)) same("exp2_of", found, asked);
    same("exp2_of a whole number", exp2_of<Real>(all(Real(-i)))[i], std::exp2(-i));
    const int piece = i / PIECE_LANES<Real>, lane = i % PIECE_LANES<Real>;
    same("exp2_of a piece", exp2_of<Real>(load_piece(rows + piece * PIECE_LANES<Real>))[lane], found);
    same("any of a piece", any(load_piece(rows + piece * PIECE_LANES<Real>) >= rows[i]), 1);
  }
  for (int64_t some = 0; some <= n; some++) {
    Real out[n] = {};
    store_some(out, load_some(rows, some), some);
    for (int i = 0; i < n; i++) same("some", out[i], i < some ? rows[i] : Real(0));
  }
}

int main() {
  std::mt19937 random(7);
  for (int trial = 0; trial < 200; trial++) {
    judge<float>(random);
    judge<double>(random);
  }
  return wrong != 0;
}
"""


@pytest.mark.skipif(find_compiler() is None, reason="there is no C++ compiler")
@pytest.mark.parametrize("level", [*LEVELS, "native", "any processor"])
def test_vectors_are_as_their_numbers(level: str, tmp_path: Path) -> None:
    if level in LEVELS and level not in building.supported_levels():
        pytest.skip(f"this processor does not run code for {level}")
    # without these words the code is what other kinds of processors get
    plain = [f"-U{word}" for word in ("__SSE2__", "__AVX2__", "__AVX512DQ__", "__FMA__")]
    tuning = plain if level == "any processor" else [f"-march={level}"]
    source, program = tmp_path / "lanes.cpp", tmp_path / "lanes"
    source.write_text(PROGRAM)
    flags = [flag for flag in building.FLAGS if flag not in ("-O3", "-shared")]
    places = [f"-I{building.CUDA.parent}", "-ffp-contract=off", "-O1"]
    command = [*(find_compiler() or []), *flags, *tuning, *places, "-o", str(program), str(source)]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr[-3000:]
    judged = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert judged.returncode == 0, judged.stdout[:3000]


# What docs/using.md says of the bits of levels.

# the level that is compiled: its vectors are half as wide as those of the one above, and it too fuses multiply-adds
LEVEL = "x86-64-v3"


def _blends(dtype: torch.dtype) -> dict[str, Tensor]:
    found = {}
    for tile_size in (8, 16):
        for profile in CEILINGS:
            given = splats(tile_size, n=400, dtype=dtype)
            sink = torch.zeros_like(given.means2d)
            image, gradients = blended(given, profile, sink)
            tensors = [image.image, image.alphas, image.dominant_ids, image.dominant_weights, *gradients, sink]
            found |= {f"blend {tile_size} {profile.name} {k}": tensor for k, tensor in enumerate(tensors)}
    return found


def _passes(dtype: torch.dtype) -> dict[str, Tensor]:
    params, made = raw_params(400, dtype), Passes("compiled", views(dtype), "paper", (0.1, 0.2, 0.3))
    seen = made.contributions(params, 0, 3, torch.rand(22, 37, generator=torch.Generator().manual_seed(9)).to(dtype))
    points = made.dominant_points(params, 0, 3)
    return {
        **{f"contributions.{name}": getattr(seen, name) for name in ("weight_sum", "map_sum", "distance_sum", "image")},
        "sensitivities": made.sensitivities(params, 0, 3),
        "fisher": made.fisher(params, 0, 3, 1),
        **{f"points {k}": tensor for k, tensor in enumerate(points)},
    }


def _losses(dtype: torch.dtype) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(4)
    drawn, photograph = (torch.rand(40, 53, 3, generator=generator).to(dtype) for _ in range(2))
    drawn.requires_grad_()
    loss = losses.photometric_pop(drawn, photograph)
    loss.backward()
    assert drawn.grad is not None
    return {"loss": loss.detach(), "gradient of the loss": drawn.grad}


def _found(folder: Path) -> dict[str, Tensor]:
    """Return what the kernels make of everything that they do: blends, sums over views, losses, trainings."""
    found: dict[str, Tensor] = {}
    for dtype in (torch.float32, torch.float64):
        for part in (_blends, _passes, _losses):
            found |= {f"{dtype} {name}": tensor.detach().clone() for name, tensor in part(dtype).items()}
    for method in ("pop", "3dgs"):
        config = tiny_config(folder / method, method, backend="compiled", checkpoint_every=0, save_steps=())
        TrainingRun(config, tiny_capture()).run()
        kept = last_checkpoint(folder / method)
        found |= {f"{method} {name}": value for name, value in kept.items() if isinstance(value, Tensor)}
    return found


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="there is no C++ compiler")
@pytest.mark.skipif(not compiled.available(), reason=compiled.why_not() or "")
@pytest.mark.skipif(LEVEL not in building.supported_levels(), reason=f"this processor does not run code for {LEVEL}")
def test_kernels_for_avx2_have_the_bits_of_this_processors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ours = _found(tmp_path / "ours")
    monkeypatch.setattr(building, "LEVELS", {"x86_64": ((LEVEL, ""),)})
    (made,) = building.build_levels(tmp_path)
    assert building.library_path() != made
    monkeypatch.setattr(library, "library_path", lambda: made)
    theirs = _found(tmp_path / "theirs")
    assert library.this_library() is library.open_library(str(made))
    assert len(ours) > 60
    different = [name for name, tensor in ours.items() if not torch.equal(tensor, theirs[name])]
    assert different == []
