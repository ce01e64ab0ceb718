# minutes: 35

# %% [markdown]
# # 8. Gradient leakage and the polarized opacity prior
#
# A trained scene is full of faint Gaussians that add next to nothing and are not pruned. At the end of this chapter you
# know what keeps them alive, how the Polarized Opacity Prior pulls every opacity to one of two poles, and what that
# does, and costs, in a scene small enough to watch whole.

# %% [markdown]
# ## The hidden still learn
#
# Light reaches a Gaussian behind others with the transmittance $T$, and so does its gradient. Put two layers of opacity
# $o$ before a faint third splat: it learns with the factor $(1 - o)^2$, small when the layers are nearly opaque, but
# not zero. POP calls this *gradient leakage*. It ends only where the pixel ends: eq. 1 is cut before the splat that
# would leave $T \leq 10^{-4}$ (early ray termination), and what is not blended has no gradient at all. Two layers reach
# that at about $o = 0.99$.
#
# A Gaussian's own opacity matters too. The pull on its screen centre is (POP paper, eq. 10)
#
# $$\frac{\partial L}{\partial \mu_i} = \left( \frac{\partial L}{\partial c} \cdot
# \frac{\partial c}{\partial \alpha_i} \right)
# \frac{\partial \alpha_i}{\partial \mu_i},
# \qquad \alpha_i = o_i\, e^{-\sigma_i} ,$$
#
# and of the three factors $\partial c / \partial \alpha_i = T_i (c_i - b_i)$ of chapter 5 does not contain $o_i$, while
# the last is proportional to it: faint Gaussians are pulled faintly, opaque ones strongly. (The paper counts
# $\partial L / \partial c$ as independent of $o_i$ as well. That holds for a given error; the error itself depends on
# every opacity along the ray.)

# %%
import numpy as np
from matplotlib.patches import Circle

from pop_ref.activations import opacities_from_logits
from pop_ref.density import POP, Rows, prune_mask, prune_rows, rows_from_params
from pop_ref.losses import l2, l2_vjp
from pop_ref.optimizer import adam_step, learning_rates
from pop_ref.pixel import SplatRows, composite_pixel, composite_pixel_vjp, zero_gradients
from pop_ref.polarization import importance_mask, pop_loss, pop_loss_vjp
from pop_ref.records import Camera
from pop_ref.render import render, render_vjp
from pop_ref.training import gaussians_from_params, params_vjp
from pop_ref.walkthrough.bugs import broken, caught
from pop_ref.walkthrough.pages import picture
from pop_ref.walkthrough.style import ACCENT, MUCH, MUTED, SECOND, axes


def gradients_of(opacities, offset=0.0, v_color=1.0):
    """Blend white splats at a pixel that lies `offset` px from their centres; go back."""
    n = len(opacities)
    rows = SplatRows([[0.5 + offset, 0.5]] * n, [[0.1, 0.0, 0.1]] * n, opacities, [[1.0]] * n)
    pixel = composite_pixel(range(n), rows, 0.5, 0.5, [0.0])
    totals = zero_gradients(n, 1)
    composite_pixel_vjp(pixel, rows, 0.5, 0.5, [0.0], [v_color], 0.0, totals)
    return pixel, totals


layers = np.linspace(0.005, 0.999, 200)
hidden = np.array([gradients_of([o, o, 0.01])[1].v_opacities[2] for o in layers])
passed = (1.0 - layers) ** 2
np.testing.assert_allclose(hidden, np.where(passed * 0.99 > 1e-4, passed, 0.0))

# a splat 3 px from the pixel, alone over black: a fixed error of 1/2, and L2 to grey 0.3
own = np.linspace(0.01, 0.99, 99)
fixed, photographed = [], []
for o in own:
    pixel, totals = gradients_of([o], 3.0)
    fixed.append(totals.v_means2d[0, 0])
    _, totals = gradients_of([o], 3.0, 2.0 * (pixel.color[0] - 0.3))
    photographed.append(totals.v_means2d[0, 0])
np.testing.assert_allclose(np.divide(fixed, own), fixed[0] / own[0])
assert np.ptp(np.divide(photographed, own)) > 0.1

fig, (left, right) = axes(2)
seen = hidden > 0.0
left.semilogy(layers[seen], hidden[seen], color=ACCENT)
left.axvspan(0.99, 1.0, color=SECOND, alpha=0.35, lw=0.0)
arrow = {"color": SECOND, "va": "center", "arrowprops": {"arrowstyle": "->", "color": SECOND}}
left.annotate("stopped", (0.995, 1e-3), (0.7, 1e-3), **arrow)
left.set(xlabel="opacity of the two layers in front", title="hidden behind two")
left.set(ylabel="gradient of the hidden opacity")
right.plot(own, np.abs(fixed), color=ACCENT, label="fixed error")
right.plot(own, np.abs(photographed), color=SECOND, label="L2 to grey 0.3")
right.set(xlabel="its own opacity", ylabel="pull on its centre", title="its own opacity")
right.legend()
picture(
    fig,
    "Left: what two layers let through to a third splat. Right: eq. 10 for a splat 3 px away, by its own opacity.",
)

# %% [markdown]
# Why is a small gradient enough to survive on? Because Adam divides a gradient by its own running size, so that one
# which keeps its sign moves a parameter by about the learning rate a step, however small it is. This holds as long as
# the gradient is large compared with Adam's $\epsilon$, the number added to the divisor to keep it from being 0. The
# programs of 3DGS and gsplat set $\epsilon = 10^{-15}$, so for them it holds for practically every gradient; with
# $\epsilon = 10^{-8}$, the default of torch, gradients much smaller than that would move next to nothing. An opacity
# reset does not help where a small gradient keeps its sign.


# %%
def steps_until(end, start, v_opacity, eps=1e-15):
    """Count Adam's steps of 0.05 until an opacity, under a fixed gradient, has passed `end`."""
    logits = {"opacities": np.array([np.log(start / (1.0 - start))])}
    m, v = {"opacities": np.zeros(1)}, {"opacities": np.zeros(1)}
    o, step = np.array([start]), 0
    while (o[0] - end) * (start - end) > 0.0:
        step += 1
        grads = {"opacities": v_opacity * o * (1.0 - o)}
        logits, m, v = adam_step(logits, grads, m, v, step, {"opacities": 0.05}, eps=eps)
        o = opacities_from_logits(logits["opacities"])
    return step


assert steps_until(0.9, 0.5, -1e-3) == steps_until(0.9, 0.5, -1e-9)

# %% [markdown]
# ### Exercise 1: predict
#
# An opacity was reset to 0.01 (logit −4.6). From then on it feels $\partial L / \partial o = -10^{-9}$, a billionth, at
# every step. Estimate after how many steps it is back over 1/2, with Adam's $\epsilon = 10^{-15}$ as in 3DGS. Would it
# be different with $10^{-8}$?

# %% answer
# $4.6 / 0.05 = 92$ steps of a learning rate each. In fact it is 69, because the logit's gradient, $o (1 - o)$ times
# that, grows with the opacity, and Adam's running size lags behind. With $\epsilon = 10^{-8}$ the logit's gradient,
# $10^{-11}$ at first, is a thousandth of $\epsilon$, the steps are as much shorter, and it takes 21,742 of them. So it
# is the tiny $\epsilon$ of 3DGS that lets gradients leak so well.
back = [steps_until(0.5, 0.01, -1e-9, eps) for eps in (1e-15, 1e-8)]
print(back, "steps")
assert back == [69, 21_742]

# %% [markdown]
# ## The prior
#
# POP splits the Gaussians of a view in two. Important are those that dominate at least one pixel (chapter 7),
# $M_i = \mathbf{1}[\mathcal{D}_i > 0]$ (eq. 7), and with $N_{\mathrm{imp}} = \sum M_i$ the prior is (eq. 8)
#
# $$L_{\mathrm{POP}} = \frac{1}{N_{\mathrm{imp}}} \sum_i M_i (1 - o_i)
# + \frac{1}{N - N_{\mathrm{imp}}} \sum_i (1 - M_i)\, o_i .$$
#
# {{source: pop_ref.polarization.pop_loss}}
#
# The mask is a constant of the step, so the gradient is as simple as can be: $-1/N_{\mathrm{imp}}$ for the important,
# $+1/(N - N_{\mathrm{imp}})$ for the rest, whatever the opacity. Through the sigmoid a logit feels that times
# $o (1 - o)$: most at 1/2, nothing at the poles.
#
# Both sides answer leakage. Important Gaussians become opaque and shield what is behind; the others fade, are pulled
# less (eq. 10), and are pruned under 0.005.

# %%
opacities = np.array([0.2, 0.7, 0.5, 0.5, 0.9])
important = importance_mask(np.array([3, 11, 0, 0, 0]))
assert important.tolist() == [True, True, False, False, False]
assert np.isclose(pop_loss(opacities, important), (0.8 + 0.3) / 2 + (0.5 + 0.5 + 0.9) / 3)
np.testing.assert_allclose(
    pop_loss_vjp(opacities, important, 1.0), [-1 / 2, -1 / 2, 1 / 3, 1 / 3, 1 / 3]
)
assert pop_loss(np.array([1.0, 1.0, 0.0]), np.array([True, True, False])) == 0.0
print("loss    ", round(pop_loss(opacities, important), 3))
print("gradient", pop_loss_vjp(opacities, important, 1.0).round(3))
assert POP.prune_opa == 0.005

# %% [markdown]
# ### Exercise 2: derive
#
# In every view 250 of 1,000 Gaussians are important. One of them is important in a fraction $f$ of the views. Leaving
# the photographs aside, for which $f$ does the prior push it up on average?


# %% answer
# The mean gradient is $-f/250 + (1 - f)/750$, which is negative for $f > 1/4$: a Gaussian that dominates in more views
# than the average one goes up, the rest goes down, even what is merely outside most views.
def mean_gradient(f, n_views=100):
    total = 0.0
    for view in range(n_views):
        mask = np.zeros(1000, dtype=bool)
        mask[1:250] = True
        # the one in question stands first; another takes its place where it is not important
        mask[0 if view < f * n_views else 250] = True
        total += pop_loss_vjp(np.full(1000, 0.5), mask, 1.0)[0]
    return total / n_views


assert mean_gradient(0.2) > 0.0 > mean_gradient(0.3)
assert np.isclose(mean_gradient(0.25), 0.0)

# %% [markdown]
# ## A flat world to watch
#
# To see it happen, take a world seen from above: a wavy, nearly opaque wall, painted, and three cameras that take
# photographs one pixel high and 28 wide. Forty Gaussians of opacity 0.1 start around the wall, with its colours and
# some noise, as points from structure-from-motion would. They are trained by the oracle with L2 and, in a second run,
# with the prior (eq. 9 without its SSIM term, whose windows are eleven pixels high).
#
# As in the paper the prior is on for the first part of the training only, here for 120 of 180 steps, and faint
# Gaussians are pruned as long as it lasts. So few steps need a faster clock: learning rates are five times the usual,
# Adam's second moment forgets in 20 steps instead of 1,000, and $\lambda_{\mathrm{POP}}$ is 0.01 instead of 0.001.

# %% setup
WIDTH, N, STEPS, POP_STEPS, WEIGHT = 28, 40, 180, 120, 0.01
C0 = 0.28209479177387814


def camera_at(turn):
    """Look at the origin from 4 units away, turned about the vertical."""
    c, s = np.cos(turn), np.sin(turn)
    viewmat = np.array([[c, 0, -s, 0], [0, 1, 0, 0], [s, 0, c, 4.0], [0, 0, 0, 1]])
    K = np.array([[1.3 * WIDTH, 0, WIDTH / 2], [0, 1.3 * WIDTH, 0.5], [0, 0, 1.0]])
    return Camera(viewmat, K, WIDTH, 1)


def params_at(x, z, scale, opacity, noise):
    """Write raw parameters of round Gaussians in the flat world, in the wall's colours."""
    n = len(x)
    paint = 0.5 + 0.4 * np.stack([np.sin(2 * x), np.cos(3 * x), np.sin(1 - 2 * x)], axis=1)
    return {
        "means": np.stack([x, np.zeros(n), z], axis=1),
        "quats": np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        "scales": np.full((n, 3), np.log(scale)),
        "opacities": np.full(n, np.log(opacity / (1.0 - opacity))),
        "sh0": ((paint - 0.5) / C0 + noise)[:, None, :],
    }


cameras = [camera_at(turn) for turn in (-0.3, 0.0, 0.3)]
along = np.linspace(-1.8, 1.8, 31)
wall = gaussians_from_params(params_at(along, 0.3 * np.sin(2 * along), 0.1, 0.98, 0.0))
photos = [render(wall, camera).image for camera in cameras]
rng = np.random.default_rng(1)
x = rng.uniform(-1.6, 1.6, N)
z = 0.3 * np.sin(2 * x) + rng.uniform(-0.6, 0.6, N)
first = params_at(x, z, 0.12, 0.1, rng.normal(0.0, 0.3, (N, 3)))


# %%
def train(weight):
    """Train with this weight of the prior; give the scene before each step and at the end."""
    rows, scenes = rows_from_params(first), []
    for step in range(STEPS):
        gaussians = gaussians_from_params(rows.params)
        scenes.append(gaussians)
        camera, photo = cameras[step % 3], photos[step % 3]
        view = render(gaussians, camera)
        gradients = render_vjp(gaussians, camera, l2_vjp(view.image, photo, 1.0))
        mask = importance_mask(view.dominant_counts)
        now = weight if step < POP_STEPS else 0.0
        v_opacities = pop_loss_vjp(gaussians.opacities, mask, now)
        grads = params_vjp(rows.params, gradients, v_opacities)
        # nothing leaves the flat world: rounding would, and Adam would follow it
        for name, outside in (
            ("means", np.s_[:, 1]),
            ("scales", np.s_[:, 1]),
            ("quats", np.s_[:]),
        ):
            grads[name][outside] = 0.0
        rates = learning_rates(step, 4.0, STEPS)
        rates = {name: 5.0 * rate for name, rate in rates.items()}
        moved = adam_step(rows.params, grads, rows.m, rows.v, step + 1, rates, (0.9, 0.95))
        rows = Rows(*moved)
        if step % 10 == 9 and step < POP_STEPS:
            after = gaussians_from_params(rows.params)
            rows = prune_rows(rows, prune_mask(after.opacities, after.scales, 4.0, step))
    return [*scenes, gaussians_from_params(rows.params)]


runs = {"without": train(0.0), "with": train(WEIGHT)}


def measured(scene):
    """Give the mean squared error and the Gaussians blended per pixel, over the three views."""
    views = [render(scene, camera) for camera in cameras]
    errors = [l2(view.image, photo) for view, photo in zip(views, photos, strict=True)]
    return np.mean(errors), np.mean([view.n_blended for view in views])


marks = np.arange(0, STEPS + 1, 12)
curves = {
    name: np.array([measured(scenes[step]) for step in marks]).T
    for name, scenes in runs.items()
}

# %%
fig, panels = axes(4, 2, height=2.9, sharex=True, sharey=True)
for row, (name, scenes) in enumerate(runs.items()):
    for column, step in enumerate((0, 40, 80, 120)):
        ax, scene = panels[4 * row + column], scenes[step]
        colours = np.clip(0.5 + C0 * scene.sh[:, 0], 0.0, 1.0)
        for mean, scale, o, colour in zip(
            scene.means, scene.scales, scene.opacities, colours, strict=True
        ):
            ax.add_patch(
                Circle((mean[0], mean[2]), 1.5 * scale[0], fc=(*colour, o), ec=MUTED, lw=0.5)
            )
        ax.set(xlim=(-2, 2), ylim=(-1.3, 1.3), aspect="equal")
        ax.set(title=f"step {step}" if row == 0 else "")
    panels[4 * row].set(ylabel=f"{name} the prior")
picture(
    fig,
    "The world from above, x to the right and z upwards, in world units; the cameras look up from below. Discs are "
    "Gaussians, as solid as they are opaque.",
)

# %%
fig, (left, right) = axes(2, height=2.9, sharey=True)
bins = np.linspace(0.0, 1.0, 21)
for ax, (name, scenes) in zip((left, right), runs.items(), strict=True):
    shares = np.array(
        [np.histogram(scene.opacities, bins)[0] / len(scene) for scene in scenes]
    ).T
    ax.imshow(
        shares, MUCH, origin="lower", extent=(0, STEPS, 0, 1), aspect="auto", vmin=0.0, vmax=0.4
    )
    ax.set(xlabel="step", title=f"{name} the prior")
    ax.grid(False)
left.set(ylabel="opacity")
right.axvline(POP_STEPS, color=SECOND, lw=1.2)
picture(
    fig,
    "Histograms of opacity, one column a step, stronger for more. Right of the line the prior is off.",
)

# %% [markdown]
# Without the prior the photographs leave opacities wherever they are of use: few end over 0.9, and most stay between
# 0.1 and 0.9. With it, at least twice as many are under 0.1 or over 0.9 when the prior ends, and a pixel blends at
# least an eighth fewer Gaussians. Once the prior is off, the photographs alone decide about the faint ones, which still
# have gradients. (A test checks these sentences for other draws and other starts. The numbers below are those of this
# run.)


# %%
def at_poles(scene):
    """Give the share of opacities under 0.1 or over 0.9."""
    return np.mean((scene.opacities < 0.1) | (scene.opacities > 0.9))


without, with_prior = runs["without"], runs["with"]
error_without, blended_without = measured(without[POP_STEPS])
error_with, blended_with = measured(with_prior[POP_STEPS])
shares = [at_poles(run[POP_STEPS]) for run in (without, with_prior)]
print("as the prior ends       without    with")
print("at a pole              {:8.0%}{:8.0%}".format(*shares))
print(f"blended per pixel      {blended_without:8.1f}{blended_with:8.1f}")
last = without[-1].opacities
assert np.mean(last > 0.9) < 0.35
assert np.mean((last > 0.1) & (last < 0.9)) > 0.5
assert shares[1] > max(0.7, 2.0 * shares[0])
assert blended_with < 0.875 * blended_without
faint = with_prior[POP_STEPS].opacities < 0.1
view = render(with_prior[POP_STEPS], cameras[1])
v_image = l2_vjp(view.image, photos[1], 1.0)
assert np.any(render_vjp(with_prior[POP_STEPS], cameras[1], v_image).opacities[faint] != 0.0)

fig, (left, right) = axes(2, height=2.8)
for name, colour in (("without", MUTED), ("with", ACCENT)):
    left.plot(marks, curves[name][1], color=colour, label=f"{name} the prior")
    right.semilogy(marks, curves[name][0], color=colour, label=f"{name} the prior")
for ax, what in ((left, "Gaussians blended per pixel"), (right, "mean squared error")):
    ax.axvline(POP_STEPS, color=SECOND, lw=1.2)
    ax.set(xlabel="step", ylabel=what)
right.legend()
picture(fig, "What the prior saves (compare the paper's figure 4b), and what it costs.")

# %% [markdown]
# It is not free. When the prior ends, the error is more than twice that of the run without it, and the steps that
# follow do not make up for it: in every start that was tried, the picture ends more than 2 dB worse. Forty Gaussians
# cannot spare any. Where there are enough, the price is small: in the paper's ablation on Mip-NeRF 360 the prior takes
# the model from 583k to 268k Gaussians and from 27.22 to 27.01 dB.
#
# Two things hardly show in so small a world. The steps are too few for all of the faint Gaussians to sink under 0.005,
# where they would be pruned. And next to no pixel stops early, since that takes two layers of about 0.99. What the
# prior saves here is reach: an opacity of 0.8 is over the floor of 1/255 up to 3.3 standard deviations from its centre,
# one of 0.03 up to 2.

# %%
final_without, final_with = measured(without[-1])[0], measured(with_prior[-1])[0]
print(f"the prior costs {10.0 * np.log10(final_with / final_without):.1f} dB;", end=" ")
n_pruned, n_faint = N - len(with_prior[-1]), np.sum(faint)
print(f"it leaves {n_faint} faint Gaussians and has pruned {n_pruned}")
assert error_with > 2.0 * error_without
assert final_with > 10.0**0.2 * final_without
assert n_pruned > 0 < n_faint
assert np.allclose(np.sqrt(2.0 * np.log(255.0 * np.array([0.8, 0.03]))), [3.3, 2.0], atol=0.05)
# what pixels went through, of what was listed for their tiles
shares = []
for camera in cameras:
    view = render(with_prior[POP_STEPS], camera)
    listed = np.array([len(ids) for ids in view.tile_lists])[np.arange(WIDTH) // 16]
    shares.append(np.mean(view.n_traversed[0] / listed))
assert min(shares) > 0.95

# %% [markdown]
# The toy of chapter 0 shows it in three dimensions, trained in this page. Train it to the end. Then change
# $\lambda_{\mathrm{POP}}$, or $\theta$ of chapter 7, and start again.
#
# {{widget: train}}

# %% [markdown]
# ### Exercise 3: predict
#
# A Gaussian with $o = 0.1$ lies where no photograph looks. The gradient of the prior is all it feels,
# $\lambda / (N - N_{\mathrm{imp}})$ with $N - N_{\mathrm{imp}} = 750$. After how many steps is it under the pruning
# threshold 0.005, for $\lambda = 10^{-3}$ and for $\lambda = 10^{-6}$?

# %% answer
# 132 in both cases: to Adam only the sign counts, so for the unseen the weight of the prior means nothing. The
# weight matters where photographs pull as well.
unseen = [steps_until(0.005, 0.1, weight / 750) for weight in (1e-3, 1e-6)]
print(unseen, "steps")
assert unseen == [132, 132]

# %% [markdown]
# ### Exercise 4: code
# Write the prior and its gradient from eq. 8, with care for the cases that all Gaussians or none are important. Check
# the gradient by differences.


# %% answer
# An empty sum is 0, so its mean is taken as 0; dividing by `max(n, 1)` does it without a branch.
def prior(o, mask):
    n, rest = max(mask.sum(), 1), max((~mask).sum(), 1)
    return np.sum(1 - o[mask]) / n + np.sum(o[~mask]) / rest, np.where(mask, -1 / n, 1 / rest)


for mask in (important, np.ones(5, dtype=bool), np.zeros(5, dtype=bool)):
    value, gradient = prior(opacities, mask)
    by_difference = [
        (prior(opacities + h, mask)[0] - prior(opacities - h, mask)[0]) / 2e-6
        for h in 1e-6 * np.eye(5)
    ]
    assert np.isclose(value, pop_loss(opacities, mask))
    assert np.allclose(gradient, by_difference)
    assert np.array_equal(gradient, pop_loss_vjp(opacities, mask, 1.0))

# %% [markdown]
# ### Exercise 5: find the bug
# Eq. 8 with one mistake. With 250 important of 1,000 Gaussians, how much stronger or weaker does each side become?
#
# {{bug: prior_over_all}}

# %% answer
# The sum of the important is divided by $N$ and not by $N_{\mathrm{imp}}$. They are pulled up with $1/1000$ instead of
# $1/250$, a quarter; the others down with $1/750$, as before. The balance shifts by four towards 0, and the model gets
# too small.
half, first_250 = np.full(1000, 0.5), np.arange(1000) < 250
for side, share in ((first_250, 1 / 4), (~first_250, 1.0)):
    losses = (pop_loss, broken("prior_over_all", "pop_loss"))
    change = [loss(half + 0.1 * side, first_250) - loss(half, first_250) for loss in losses]
    assert np.isclose(change[1] / change[0], share)
print(caught("prior_over_all"))
