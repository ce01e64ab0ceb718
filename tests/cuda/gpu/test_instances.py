"""How many (splat, tile) instances there are: counts that pass what an int holds, and room that follows the need."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from cuda_ext import load
from cuda_ext.arrays import N_INSTANCES, OVERFLOW, CudaMemoryError, fill, kernel_profile, new_state, stream_of
from cuda_ext.render import lists as lists_module
from cuda_ext.render.lists import TileBuffers, count_instances, splat_struct
from pop_fast.cuda import rasterization
from pop_fast.train.steps import Phase
from pop_ref.constants import PAPER
from tests.cuda.gpu.scene import (
    HEIGHT,
    STEPS,
    THETA,
    WIDTH,
    N,
    apart,
    assert_gradients_close,
    assert_same_bits,
    fused,
    fused_trainer,
    leaves_of,
    on_the_cpu,
    training_scene,
)

# 30,000 x 30,000 tiles of 16 x 8 px; a splat that covers them all has as many instances
ACROSS, PER_SPLAT = 30_000, 900_000_000
INT_MAX = 2**31 - 1


def wide_splats(gpu, n, lists):
    """Return splats that cover every tile of a huge grid, and the lists' struct made ready to count them."""
    kernels = load()
    lists.n, lists.exact = n, False
    lists.set_grid(16 * ACROSS, 8 * ACROSS, 16, 8)
    assert lists.n_tiles == PER_SPLAT
    names = ("depth_keys", "depth_keys_sorted", "order_unsorted", "order", "splat_begin", "splat_count")
    for name in names:
        fill(lists, **{name: torch.zeros(n, dtype=torch.int32, device=gpu)})
    lists.workspace_bytes = kernels.tile_workspace(n, 1024, PER_SPLAT)
    fill(lists, workspace=torch.zeros(lists.workspace_bytes, dtype=torch.uint8, device=gpu))
    middle = torch.tensor([8.0 * ACROSS, 4.0 * ACROSS], device=gpu).repeat(n, 1)
    return splat_struct(
        middle,
        torch.arange(1.0, n + 1, device=gpu),
        torch.ones((n, 3), device=gpu),
        torch.ones(n, device=gpu),
        torch.full((n, 2), 16 * ACROSS, dtype=torch.int32, device=gpu),
        None,
    )


@pytest.mark.parametrize("n", [2, 3, 4, 5, 6, 9, 10])
def test_instances_beyond_an_int_are_the_largest_int_and_not_few(gpu, n):
    kernels, state = load(), new_state(gpu)
    lists = kernels.TileLists()
    splats = wide_splats(gpu, n, lists)
    count_instances(lists, splats, kernel_profile(PAPER, 16), state.data_ptr(), gpu)
    assert state[N_INSTANCES] == min(n * PER_SPLAT, INT_MAX)


@pytest.mark.parametrize("before", [2**31 - 40, 2**31 - 1, 2**31, 2**32 - 1])
def test_a_count_that_passes_an_int_halts_the_device_and_lists_nothing(gpu, before):
    state, buffers, splats = counted(gpu)
    buffers.reserve(1024)
    # the last splat's slots as they are behind a multitude of others
    last = int(buffers.tensor("order")[-1])
    buffers.tensor("splat_begin")[last] = before if before <= INT_MAX else before - 2**32
    buffers.tensor("splat_count")[last] = 45
    kernels, profile = load(), kernel_profile(PAPER, 16)
    kernels.make_tile_lists(buffers.struct, splats, profile, 0, state.data_ptr(), stream_of(gpu))
    assert state[OVERFLOW] == state[N_INSTANCES] == INT_MAX
    for name in ("tile_begin", "tile_end"):
        assert not buffers.tensor(name).any(), name


def counted_lists(gpu, rows, width, height):
    """Count the tiles that splats reach; return the state, the lists' buffers and the splats."""
    rows = {name: value.to(gpu).contiguous() for name, value in rows.items()}
    splats, n = splat_struct(**rows, colors=None), len(rows["depths"])
    state, buffers = new_state(gpu), TileBuffers(n, width, height, (16, 8), True, gpu, buckets=False)
    count_instances(buffers.struct, splats, kernel_profile(PAPER, 16), state.data_ptr(), gpu)
    return state, buffers, splats


def made_lists(gpu, rows, width, height):
    """Make the lists of splats; return what is listed, where the lists of the tiles begin, and where they end."""
    state, buffers, splats = counted_lists(gpu, rows, width, height)
    total = int(state[N_INSTANCES])
    buffers.reserve(total)
    load().make_tile_lists(buffers.struct, splats, kernel_profile(PAPER, 16), 0, state.data_ptr(), stream_of(gpu))
    listed, begin, end = (buffers.tensor(name).long().cpu() for name in ("listed", "tile_begin", "tile_end"))
    assert int((end - begin).sum()) == total
    return listed, begin, end


def turned(sizes, g):
    """Return conics and covariances of ellipses of so many px along their axes, turned in every direction."""
    turn = 3.2 * torch.rand(len(sizes), generator=g)
    axes = torch.stack((torch.cos(turn), torch.sin(turn), -torch.sin(turn), torch.cos(turn)), 1).view(-1, 2, 2)
    covariance = axes @ torch.diag_embed(sizes.square()) @ axes.mT
    inverse = torch.linalg.inv(covariance)
    return torch.stack((inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]), 1), covariance


def counted(gpu):
    """Return the state, the lists and the splats of a scene of discs, which has been counted."""
    g = torch.Generator().manual_seed(0)
    rows = {
        "means2d": torch.rand((N, 2), generator=g) * 40.0,
        "depths": torch.rand(N, generator=g) + 1.0,
        "conics": torch.tensor([0.1, 0.0, 0.1]).repeat(N, 1),
        "opacities": torch.full((N,), 0.5),
        "radii": torch.full((N, 2), 9, dtype=torch.int32),
    }
    return counted_lists(gpu, rows, 48, 36)


def test_more_entries_than_the_kernels_can_number_are_refused_in_one_line(gpu):
    _, buffers, _ = counted(gpu)
    with pytest.raises(CudaMemoryError, match=r"would have 2,147,483,647 entries or more; .* lower the number"):
        buffers.reserve(INT_MAX)


def test_room_shrinks_after_a_phase_of_fat_splats_and_the_steps_stay_the_same(gpu, monkeypatch):
    monkeypatch.setattr(lists_module, "FIRST_GUESS", (0, 64))
    phase, scene = Phase(3, True, True, True), training_scene()
    fat = {**scene.params, "scales": scene.params["scales"] + 1.5}
    (params, m, v), trainer = fused_trainer(replace(scene, params=fat), gpu)
    trainer.run(3, phase)
    ((size, lists),) = trainer.lists().items()
    assert trainer.grown > 0
    params["scales"].copy_(scene.params["scales"] - 0.5)
    trainer.rebind(params, m, v)
    trainer.run(6, phase)
    assert trainer.lists()[size].capacity == lists.capacity
    grown, thin = trainer.grown, trainer.n_instances
    trainer.rebind(params, m, v)
    trainer.run(STEPS, phase)
    assert thin <= trainer.lists()[size].capacity < 0.5 * lists.capacity
    assert trainer.grown == grown


# Ten steps on the GPU against the CPU's under other readings of what the paper leaves open (A1, A2, A12).

READINGS = (
    {"pop_over": "visible"},
    {"pop_views": "window"},
    {"pop_over": "visible", "pop_views": "window"},
    {"blur_window": "any_view"},
)


@pytest.mark.parametrize("backward", ["pixel_parallel", "gaussian_parallel"])
@pytest.mark.parametrize("reading", READINGS, ids=lambda reading: "-".join(reading.values()))
def test_ten_fused_steps_under_another_reading_are_the_cpus(gpu, reading, backward):
    scene, strong = training_scene(), {"lambda_pop": 0.05}
    # no view shows all, and one shows others than the two beside it
    scene.params["means"][:16, 2] *= -1.0
    scene.viewmats[2, 0, 3] = 1.5
    window = reading.get("pop_views") == "window"
    losses, params, trainer = fused(scene, gpu, window, backward=backward, theta_blur=THETA, **strong, **reading)
    expected, terms, wanted, state = on_the_cpu(scene, **strong, **reading)
    torch.testing.assert_close(torch.tensor(losses), torch.tensor(expected), rtol=1e-4, atol=1e-6)
    told = torch.tensor([values[4] for values in trainer.step_stats(0, STEPS)])
    torch.testing.assert_close(told, torch.tensor(terms), rtol=1e-4, atol=1e-6)
    for name, value in wanted.items():
        assert apart(params[name], value, name) < 0.01, name
    found = trainer.statistics
    assert torch.equal(found.blurred.bool().cpu(), state["blurred"])
    if window:
        assert torch.equal(found.dominant_sum.long().cpu(), state["dominant_sum"])
    # and the reading matters here
    *_, usual, usual_state = on_the_cpu(scene, **strong)
    if "blur_window" in reading:
        assert 0 < int(usual_state["blurred"].sum()) < int(state["blurred"].sum())
    else:
        assert apart(usual["opacities"], wanted["opacities"], "opacities") > 0.05


def test_the_share_that_blurs_is_of_the_pixels_that_a_view_keeps(gpu):
    scene = training_scene()
    masks = [None if k % 2 else torch.arange(WIDTH) < WIDTH // 4 for k in range(len(scene.photographs))]
    masks = [None if mask is None else mask.expand(HEIGHT, WIDTH) for mask in masks]
    _, trainer = fused_trainer(scene, gpu, masks, theta_blur=THETA, blur_window="own_view", replay=False)
    differs = 0
    for step in range(STEPS):
        trainer.run(step + 1, Phase(3, True, True, True))
        ((_, maps),) = trainer.render_stats().items()
        counts, masked = maps["dominant_counts"].cpu(), masks[scene.order[step]] is not None
        kept = WIDTH // 4 * HEIGHT if masked else WIDTH * HEIGHT
        assert torch.equal(trainer.statistics.blurred.bool().cpu(), counts > THETA * kept), step
        differs += int((counts > THETA * kept).sum() - (counts > THETA * WIDTH * HEIGHT).sum())
    assert differs > 0


def test_exact_lists_hold_the_tiles_that_a_splat_reaches_and_no_others(gpu):
    # rectangles of no tile, of one and of the whole image, and needles, in one warp and over the end of another
    g = torch.Generator().manual_seed(4)
    n, width, height = 75, 260, 130
    conics, covariance = turned(torch.exp(4.5 * torch.rand((n, 2), generator=g)) * torch.tensor([1.0, 0.4]), g)
    opacities = 0.02 + 0.97 * torch.rand(n, generator=g)
    widths = torch.sqrt(2.0 * torch.log(255.0 * opacities))[:, None] * covariance.diagonal(dim1=1, dim2=2).sqrt()
    radii = torch.ceil(widths).int()
    radii[::7] = 0
    means2d = torch.rand((n, 2), generator=g) * torch.tensor([width + 80.0, height + 80.0]) - 40.0
    depths = torch.rand(n, generator=g)
    rows = {"means2d": means2d, "depths": depths, "conics": conics, "opacities": opacities, "radii": radii}
    listed, begin, end = made_lists(gpu, rows, width, height)

    reach = torch.log(255.0 * opacities.double())
    offsets = torch.arange(0.5, 16.0, 0.1, dtype=torch.float64)
    for tile, (first, last) in enumerate(zip(begin.tolist(), end.tolist(), strict=True)):
        y, x = divmod(tile, -(-width // 16))
        ids = listed[first:last]
        # in the tile's box, where it is inside the image: at pixel centres, and on a grid ten times as fine
        right, bottom = (min(16, width - 16 * x), min(8, height - 8 * y))
        fine = torch.cartesian_prod(offsets[: 10 * right - 9] + 16 * x, offsets[: 10 * bottom - 9] + 8 * y)
        d = means2d[:, None].double() - fine
        A, B, C = conics.double()[:, :, None].unbind(1)
        sigma = 0.5 * (A * d[..., 0] ** 2 + C * d[..., 1] ** 2) + B * d[..., 0] * d[..., 1]
        centres = ((fine - 0.5) % 1.0).sub(0.5).abs().amin(1) > 0.49
        inside = (radii > 0).all(1)
        must = (sigma[:, centres].amin(1) <= reach) & inside
        may = (sigma.amin(1) <= reach + 0.15) & inside
        held = torch.zeros(n, dtype=torch.bool)
        held[ids] = True
        assert bool((held >= must).all()), tile
        assert bool((held <= may).all()), tile
        assert ids.tolist() == sorted(ids.tolist(), key=lambda i: (float(depths[i]), i))
    lengths = end - begin
    assert 0 in lengths
    assert int(lengths.max()) > 8


def test_rows_of_a_rectangle_are_exact_where_a_float_cannot_number_its_tiles(gpu):
    # a band of 3 px over 12 million tiles, of which it reaches those of its rows alone
    across, down = 6_001, 2_000
    rows = {
        "means2d": torch.tensor([[8.0 * across, 8.0 * down - 4.0]]),
        "depths": torch.ones(1),
        "conics": torch.tensor([[1e-12, 0.0, 1.0]]),
        "opacities": torch.tensor([0.05]),
        "radii": torch.full((1, 2), 16 * across, dtype=torch.int32),
    }
    _, begin, end = made_lists(gpu, rows, 16 * across, 8 * down)
    assert torch.equal((end > begin).nonzero()[:, 0], torch.arange(across) + (down - 1) * across)


def test_a_splat_whose_conic_is_0_reaches_every_tile_of_its_rectangle(gpu):
    # its centre is in no tile's box, in one's columns, in one's rows; the determinant of 1e10 px is beyond a float
    rows = {
        "means2d": torch.tensor([[-50.0, -40.0], [20.0, -40.0], [-50.0, 12.0], [20.0, 12.0]]),
        "depths": torch.ones(4),
        "conics": torch.tensor([[0.0, -0.0, 0.0]]).repeat(4, 1),
        "opacities": torch.full((4,), 0.5),
        "radii": torch.full((4, 2), INT_MAX - 127, dtype=torch.int32),
    }
    listed, begin, end = made_lists(gpu, rows, 40, 30)
    assert (end - begin).tolist() == [4] * 12
    assert listed.tolist() == [0, 1, 2, 3] * 12


def test_tiles_of_a_block_beyond_its_words_are_those_of_each_splat_alone(gpu):
    n, g = 20, torch.Generator().manual_seed(11)
    conics, covariance = turned(torch.tensor([[400.0, 30.0]]).repeat(n, 1), g)
    rows = {
        "means2d": torch.rand((n, 2), generator=g) * torch.tensor([1040.0, 520.0]),
        "depths": torch.rand(n, generator=g),
        "conics": conics,
        "opacities": torch.full((n,), 0.9),
        "radii": torch.ceil(3.3 * covariance.diagonal(dim1=1, dim2=2).sqrt()).int(),
    }
    rows["radii"][::5] = 0

    def listed(chosen):
        ids, begin, end = made_lists(gpu, {name: value[chosen] for name, value in rows.items()}, 1040, 520)
        return {(chosen[ids[k]], tile) for tile in range(65 * 65) for k in range(begin[tile], end[tile])}

    # more tiles are tried than a block has words for, so that splats begin and end in the middle of a round
    assert 16 * 65 * 65 > 32 * 1024
    assert listed(list(range(n))) == set.union(*(listed([k]) for k in range(n) if k % 5))


def test_splats_of_many_slots_have_the_gradients_of_atomic_additions(gpu):
    g, n, width, height = torch.Generator().manual_seed(3), 70, 272, 136
    means = torch.rand((n, 3), generator=g) * torch.tensor([4.0, 2.0, 1.0]) + torch.tensor([-2.0, -1.0, 4.0])
    scales = torch.full((n, 3), 0.03)
    # two of one block of warps, and the last of all: they reach most of the 289 tiles
    scales[[3, 35, 36, 69]] = 1.5
    leaves = {"means": means, "quats": torch.randn((n, 4), generator=g), "scales": scales}
    leaves |= {"opacities": 0.1 + 0.2 * torch.rand(n, generator=g), "colors": torch.rand((n, 3), generator=g)}
    K = torch.tensor([[[200.0, 0.0, width / 2], [0.0, 200.0, height / 2], [0.0, 0.0, 1.0]]], device=gpu)
    v = torch.rand((1, height, width, 3), generator=g).to(gpu)

    def gradients(**options):
        own = leaves_of(leaves, gpu)
        image, _, meta = rasterization(*own.values(), torch.eye(4, device=gpu)[None], K, width, height, **options)
        (image * v).sum().backward()
        return {name: value.grad.cpu() for name, value in own.items()}, meta

    by_slots, meta = gradients(packed=False)
    assert_same_bits(gradients(packed=False)[0], by_slots)
    # of 16 x 16 px: twice as many of the lists' own
    assert sorted(meta["tiles_per_gauss"].flatten().tolist())[-4] >= 80
    for backward in ("pixel_parallel", "gaussian_parallel"):
        assert_gradients_close(gradients(packed=False, deterministic=False, backward=backward)[0], by_slots)
