"""Sixteen numbers side by side are the same numbers, however wide the processor's vectors are; and so is a training."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from cuda_ext.toolkit import find_compiler
from pop_fast import compiled
from pop_fast.compiled import build as building
from pop_fast.compiled import library, losses
from pop_fast.density.passes import Passes
from pop_fast.train import TrainingRun
from pop_ref.constants import INRIA, PAPER
from tests.app.tiny import last_checkpoint, tiny_capture, tiny_config
from tests.fast.test_compiled import blended, native, splats
from tests.fast.test_passes import raw_params, views

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
    const double found = exp2_of(e)[i], asked = std::exp2(double(rows[i]));
    if (!(std::abs(found - asked) <= 3e-7 * asked)) same("exp2_of", found, asked);
    same("exp2_of a whole number", exp2_of(all(Real(-i)))[i], std::exp2(-i));
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
CEILINGS = (PAPER, replace(INRIA, alpha_ceiling=0.7))


def _blends(dtype: torch.dtype) -> dict[str, Tensor]:
    found = {}
    for tile_size in (8, 16):
        for profile in CEILINGS:
            given = splats(tile_size, n=400, dtype=dtype)
            sink = torch.zeros_like(given.means2d)
            image, gradients = blended(native, given, profile, sink=sink)
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
