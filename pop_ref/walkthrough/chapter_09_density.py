# %% [markdown]
# # 9. Clone, split, prune, reset: why POP needs no reset
#
# Training changes not only the Gaussians but how many there are. At the end of this chapter you know who is cloned, who
# is split and who is pruned, what happens to the optimizer's memory when rows come and go, what an opacity reset does
# to a picture, and what the Polarized Opacity Prior does in its place.
#
# ## Who is asking for help
#
# A Gaussian that covers too much, or lies next to something that nobody covers, is pulled about: the loss would fall if
# it moved. The pull on its screen centre $\mu_i^{2D}$ is measured view by view, and a Gaussian is selected when the
# average is large (POP paper, eq. 3; 3DGS, section 5.2):
#
# $$\frac{1}{V} \sum_{k=1}^{V} \sqrt{\left(\frac{\partial L_k}{\partial \mu_i^{2D,x}}\right)^2 +
# \left(\frac{\partial L_k}{\partial \mu_i^{2D,y}}\right)^2} > \tau_{\mathrm{Den}} .$$
#
# The unit of length is half an image, not a pixel: the norm is of $(\frac{W}{2} v_x, \frac{H}{2} v_y)$. Here are four
# Gaussians before one camera. The first is too short for its stripe, the second covers two dots with one blur, the
# third is right, and the fourth is all but transparent. (With four Gaussians in 576 pixels every pull is strong, so the
# threshold is $3 \cdot 10^{-3}$ here; in training it is $\tau_{\mathrm{Den}} = 2 \cdot 10^{-4}$.)

# %%
from dataclasses import replace

import numpy as np

from pop_ref import density, training
from pop_ref.activations import opacities_from_logits, opacities_from_logits_vjp
from pop_ref.compositing import composite, composite_vjp
from pop_ref.losses import l2, l2_vjp, photometric_pop_vjp
from pop_ref.optimizer import adam_step, learning_rates
from pop_ref.polarization import importance_mask, pop_loss_vjp
from pop_ref.records import Camera, Splats
from pop_ref.render import render, render_vjp
from pop_ref.tiles import tile_lists
from pop_ref.walkthrough.pages import picture
from pop_ref.walkthrough.style import ACCENT, MUTED, SECOND, THIRD, axes, show_image

WHITE = np.ones(3)
COLORS = {"blue": (-0.8, -0.2, 0.9), "orange": (1.3, 0.0, -1.2), "green": (-0.9, 0.4, -0.5)}


def camera_of(size):
    """Look along z; at depth 4 one unit is `size / 4` px."""
    K = np.array([[size, 0.0, size / 2], [0.0, size, size / 2], [0.0, 0.0, 1.0]])
    return Camera(np.eye(4), K, size, size)


def logit(o):
    return np.log(o) - np.log1p(-np.asarray(o))


def params_of(*lines):
    """Write raw parameters from lines "x y sx sy opacity colour", all on the plane at depth 4."""
    *numbers, names = zip(*(line.split() for line in lines), strict=True)
    x, y, sx, sy, o = np.array(numbers, dtype=float)
    return {
        "means": np.stack([x, y, 4.0 + 0.0 * x], axis=1),
        "scales": np.log(np.stack([sx, sy, 0.2 + 0.0 * x], axis=1)),
        "quats": np.tile([1.0, 0.0, 0.0, 0.0], (len(x), 1)),
        "opacities": logit(o),
        "sh0": np.array([[COLORS[name]] for name in names]),
    }


def drawn(params, camera):
    return render(training.gaussians_from_params(params), camera, background=WHITE)


def pulled(params, camera, target, **options):
    """Draw, compare, and return the view with its gradients."""
    view = drawn(params, camera)
    v_image = photometric_pop_vjp(view.image, target, 1.0, **options)
    gaussians = training.gaussians_from_params(params)
    return view, render_vjp(gaussians, camera, v_image, background=WHITE)


camera, right = camera_of(24), "-1.0 1.1 0.4 0.4 0.95 green"
short, stripe = "-1.25 -0.8 0.15 0.15 0.95 blue", "-0.95 -0.8 0.45 0.15 0.95 blue"
wide = "0.9 -0.7 0.5 0.5 0.8 orange"
dots = "0.6 -1.1 0.2 0.2 0.95 orange", "1.2 -0.3 0.2 0.2 0.95 orange"
target = drawn(params_of(stripe, *dots, right), camera).image
params = params_of(short, wide, right, "1.0 1.1 0.3 0.3 0.004 blue")
view, v = pulled(params, camera, target)

config = replace(density.POP, grow_grad2d=3e-3)
seen = (v.means2d, view.splats.visible, view.dominant_counts, 24, 24)
window = density.accumulate(density.zero_statistics(4), *seen)
pull = density.average_grads(window)
assert density.POP.grow_grad2d == 2e-4
assert density.POP.refine_every == 100
assert np.allclose(pull, np.hypot(*(12.0 * v.means2d.T)), rtol=1e-12)
assert (pull > config.grow_grad2d).tolist() == [True, True, False, False]
print("pull: too short {:.4f}, too wide {:.4f}, right {:.4f}, faint {:.4f}".format(*pull))

# %% [markdown]
# ## One event
#
# Every 100 steps the window closes and the population is edited. Selected and small: **clone**, a copy on top of the
# original. Selected and large: **split**, two children drawn from the parent's own distribution, 1.6 times smaller, in
# its place. Small means that the largest scale is at most 0.01 of the scene's. Then **prune**: what has an opacity
# under 0.005 is removed, and late in the training what is far too large. (A child's place is drawn at random; here two
# draws are picked that make a clear picture.)

# %%
SCENE_SCALE, STEP = 30.0, 600
assert density.POP.grow_scale3d == 0.01
assert density.POP.prune_opa == 0.005
fresh, grads = density.rows_from_params(params), training.params_vjp(params, v, np.zeros(4))
moved = adam_step(params, grads, fresh.m, fresh.v, 1, learning_rates(STEP, SCENE_SCALE))
rows = density.Rows(*moved)

scales = np.exp(rows.params["scales"])
clone, split = density.grow_masks(window, scales, SCENE_SCALE, STEP, config)
assert clone.tolist() == [True, False, False, False]
assert split.tolist() == [False, True, False, False]
draws = np.array([[[-0.6, -0.8, 0.0]], [[0.6, 0.8, 0.0]]])
event = (window, SCENE_SCALE, STEP, lambda n: draws, config)
after, _ = density.densify_and_prune(rows, *event)
# one clone more, two children for one parent, one pruned
assert len(after) == 4 + 1 + 1 - 1


def outline(ax, splats, row, color, dashed=False):
    """Draw two standard deviations of a splat."""
    (a, b, c), t = splats.conics[row], np.linspace(0.0, 2.0 * np.pi, 60)
    root = np.linalg.cholesky(np.linalg.inv(np.array([[a, b], [b, c]])))
    x, y = splats.means2d[row][:, None] + 2.0 * root @ [np.cos(t), np.sin(t)]
    ax.plot(x, y, color, ls="--" if dashed else "-")


fig, panels = axes(3, sharey=True)
edited = drawn(after.params, camera)
show_image(panels[0], target, "target")
show_image(panels[1], view.image, "before: who is pulled where")
show_image(panels[2], edited.image, "after: 5 Gaussians")
for panel in panels:
    panel.set(xlim=(0, 24), ylim=(24, 0), xlabel="x [px]")
for row, color in enumerate((ACCENT, SECOND, THIRD, "#888888")):
    outline(panels[1], view.splats, row, color, dashed=row == 3)
    if row < 2:
        arrow = -5.0 * v.means2d[row] / np.hypot(*v.means2d[0])
        panels[1].arrow(*view.splats.means2d[row], *arrow, color=color, head_width=0.8)
for row, color in enumerate((ACCENT, THIRD, ACCENT, SECOND, SECOND)):
    outline(panels[2], edited.splats, row, color)
picture(
    fig,
    "Outlines at two standard deviations. Blue, small and pulled along its stripe, is cloned in place: two outlines, "
    "one on the other. Orange, large and pulled, is split. Green is left alone. The dashed one is pruned.",
)

# %% [markdown]
# ## Rows, and what the optimizer remembers of them
#
# To the optimizer a Gaussian is a row of every parameter tensor, and for each tensor Adam keeps two more of its shape:
# $m$, a running mean of the gradient, and $v$, one of its square (Kingma and Ba 2015). A row operation moves all three
# together. Survivors keep their bits; newcomers start with zero moments; Adam's step counter belongs to the tensor and
# runs on. Where $m$ and $v$ are left behind, every Gaussian behind the first gap goes on with a stranger's momentum:
# this has happened to others, and is one of the mutants of [chapter 12](chapter_12_break_it.py).

# %%
for before, now in ((rows.params, after.params), (rows.m, after.m), (rows.v, after.v)):
    for name in before:
        assert np.array_equal(before[name][[0, 2]], now[name][:2])
for moments in (after.m, after.v):
    assert not any(moments[name][2:].any() for name in moments)
# a clone is an exact copy; children are smaller by 1.6
assert np.array_equal(after.params["means"][2], rows.params["means"][0])
shrunk = rows.params["scales"][1] - np.log(1.6)
assert np.allclose(after.params["scales"][3:], shrunk, rtol=1e-12)
largest = np.abs(after.m["means"]).max(axis=1)
print("largest |m| of the means, row by row:", largest.round(5).tolist())

# %% [markdown]
# ## The reset
#
# So far nothing removes a Gaussian that is useless but not faint. 3DGS therefore **resets**: every 3,000 steps all
# opacities are lowered to at most 0.01 (the paper writes $o_i \to 0$, section 3.1), so that only what is needed climbs
# back. Watch it with geometry standing still, opacities and colours learning. Six splats form a wall, which is all that
# the photograph shows; six are hidden behind it, two are haze before it. One run resets at step 80 and at 160. The
# other has the prior of [chapter 8](chapter_08_polarized_opacity.py) instead, with a weight that makes
# $\lambda_{\mathrm{POP}}$ times the number of steps what it is in the paper: a push adds up.

# %%
WIDTH, HEIGHT, STEPS = 10, 6, 240
assert density.GSPLAT.reset_every == 3000
assert density.GSPLAT.reset_opa == 0.01
rng = np.random.default_rng(1)
wall = [(x, y) for y in (1.5, 4.5) for x in (1.5, 5.0, 8.5)]
place = np.array([*wall, *wall, (3.0, 3.0), (7.0, 3.0)])
spread = np.repeat([1.6, 1.6, 2.5], [6, 6, 2])
depth = np.repeat([2.0, 3.0, 1.0], [6, 6, 2])
first_opacity = np.repeat([0.5, 0.3, 0.1], [6, 6, 2])
hue = rng.uniform(0.1, 0.9, (6, 3))
near_hue, any_hue = hue + rng.normal(0.0, 0.1, (6, 3)), rng.uniform(0.0, 1.0, (6, 3))
guess = np.concatenate([near_hue, any_hue, np.full((2, 3), 0.5)])


def blended(function, params, *cotangent):
    """Call `composite` or its transpose on rows that say who they are, how opaque, and of which colour."""
    who = params["who"]
    conics = spread[who, None] ** -2.0 * [1.0, 0.0, 1.0]
    radii, o = np.full((len(who), 2), 9), opacities_from_logits(params["opacities"])
    splats = Splats(place[who], depth[who], conics, o, params["colors"], radii)
    lists = tile_lists(splats.means2d, radii, splats.depths, WIDTH, HEIGHT, 16)
    return function(splats, lists, WIDTH, HEIGHT, 16, *cotangent)


def trained(config, lambda_pop):
    """Train; return PSNR and opacities (nan where pruned) before every step, and who is left."""
    first = {"who": np.arange(14), "opacities": logit(first_opacity), "colors": guess}
    rows = density.rows_from_params(first)
    rates = {"who": 0.0, "opacities": 0.05, "colors": 0.0025}
    psnr, opacities = np.zeros(STEPS), np.full((STEPS, 14), np.nan)
    for t in range(STEPS):
        x, now = rows.params, blended(composite, rows.params)
        o = opacities[t, x["who"]] = opacities_from_logits(x["opacities"])
        psnr[t] = -10.0 * np.log10(l2(now.image, photograph))
        v = blended(composite_vjp, x, l2_vjp(now.image, photograph, 1.0))
        mask = importance_mask(now.dominant_counts)
        v_o = v.v_opacities + pop_loss_vjp(o, mask, lambda_pop)
        v_logits = opacities_from_logits_vjp(x["opacities"], v_o)
        grads = {"who": 0.0 * o, "opacities": v_logits, "colors": v.v_colors}
        moved, m, v = adam_step(x, grads, rows.m, rows.v, t + 1, rates)
        rows = density.Rows({**moved, "who": x["who"]}, m, v)
        if density.densifies_at(t, config):
            faint = density.prune_mask(o, np.ones((len(o), 3)), 1.0, t, config)
            rows = density.prune_rows(rows, faint)
        if density.resets_at(t, config):
            rows = density.reset_opacities(rows, config.reset_opa)
    return psnr, opacities, rows.params["who"]


true = {"who": np.arange(6), "opacities": np.full(6, 4.0), "colors": hue}
photograph = blended(composite, true).image
calendar = replace(density.POP, refine_start_iter=0, refine_every=10)
with_reset = trained(replace(calendar, reset_every=80), 0.0)
with_prior = trained(calendar, 1e-3 * 15_000 / STEPS)

psnr, opacities, left = with_reset
# a reset costs 25 dB, and twice eighty steps do not bring the picture back
assert psnr[80] - psnr[81] > 25.0
assert psnr[81:].max() < psnr[80]
# twenty steps later nobody has sorted good from bad: all climb in step, and all stay
assert np.allclose(opacities[81], 0.01)
assert np.ptp(opacities[100]) < 1e-3
assert len(left) == 14
psnr, opacities, left = with_prior
# the prior leaves the wall, all but opaque, and no step costs half a decibel
assert left.tolist() == [0, 1, 2, 3, 4, 5]
assert opacities[-1, :6].min() > 0.97
assert np.diff(psnr).min() > -0.5

fig, panels = axes(3, height=2.6)
runs = {"reset": with_reset, "prior": with_prior}
for panel, (name, run) in zip(panels, runs.items(), strict=False):
    for first, last, label in ((0, 6, "wall"), (6, 12, "hidden"), (12, 14, "haze")):
        color = {"wall": ACCENT, "hidden": SECOND, "haze": THIRD}[label]
        lines = panel.plot(run[1][:, first:last], color=color, lw=1.0)
        lines[0].set_label(label)
    panel.set(title=f"opacities with {name}", xlabel="step", ylim=(-0.02, 1.02))
    panels[2].plot(run[0], color=MUTED if name == "reset" else ACCENT, label=name)
panels[1].legend(loc="center right")
panels[2].set(title="PSNR [dB]", xlabel="step")
panels[2].legend()
picture(
    fig,
    "A reset throws all opacities down, needed or not, and they climb back together. The prior tells them apart from "
    "the start; a line ends where its splat is pruned. Right: what either does to the picture.",
)

# %% [markdown]
# Why do the useless climb back? Adam divides by the gradient's own size, so a faint but steady gradient makes as long
# steps as a strong one; and with the wall transparent, light reaches what was hidden. The paper calls it gradient
# leakage. The prior asks another question, at every step: does this Gaussian dominate a pixel? What does is pushed up,
# which darkens what lies behind and takes its gradient away; what does not is pushed down until the ordinary prune
# finds it. The picture never breaks, so there is nothing to recover from.
#
# This is a toy with one view and fixed geometry. In the paper's ablation (section 5.2, Mip-NeRF 360) resets in place of
# the prior end with 548 thousand Gaussians and 26.82 dB, the prior with 268 thousand and 27.01 dB.

# %% [markdown]
# ### Exercise 1
#
# Why half an image and not a pixel? Measure one pull in images of 24 by 24 and of 48 by 48 pixels, in both units. Leave
# SSIM out (`lambda_ssim=0`), since its window is in pixels.

# %% answer
# The loss is a mean and does not know the resolution, so its derivative by half an image does not either. A pixel that
# is half as long moves the picture half as much.
measured = {}
for size in (24, 48):
    wish = drawn(params_of("0.3 0.0 0.6 0.6 0.9 blue"), camera_of(size)).image
    _, v = pulled(
        params_of("0.0 0.0 0.6 0.6 0.9 blue"), camera_of(size), wish, lambda_ssim=0.0
    )
    one = density.accumulate(
        density.zero_statistics(1), v.means2d, np.array([True]), np.array([1]), size, size
    )
    measured[size] = np.array([np.hypot(*v.means2d[0]), one.grad_sum[0]])
per_px, per_half_image = measured[48] / measured[24]
assert abs(per_px - 0.5) < 0.03
assert abs(per_half_image - 1.0) < 0.06

# %% [markdown]
# ### Exercise 2
#
# A Gaussian that no photograph shows feels the prior alone. How many steps does Adam, at the paper's rate 0.05, need to
# bring its opacity from 0.1 under 0.005? How does the answer depend on $\lambda_{\mathrm{POP}}$?


# %% answer
# Between 110 and 150, whatever the weight: Adam divides by the size of the gradient. Only where photographs pull too
# does the weight decide who wins.
def steps_to_prune(lambda_pop):
    x, m, v, step = {"o": logit(np.array([0.1]))}, {"o": np.zeros(1)}, {"o": np.zeros(1)}, 0
    while (o := opacities_from_logits(x["o"]))[0] >= density.POP.prune_opa:
        step += 1
        v_o = pop_loss_vjp(o, np.array([False]), lambda_pop)
        x, m, v = adam_step(
            x, {"o": opacities_from_logits_vjp(x["o"], v_o)}, m, v, step, {"o": 0.05}
        )
    return step


assert steps_to_prune(1e-3) == steps_to_prune(1e-6)
assert 110 < steps_to_prune(1e-3) < 150
