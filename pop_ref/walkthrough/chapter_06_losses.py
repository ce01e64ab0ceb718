# minutes: 35

# %% [markdown]
# # 6. What a loss pulls with: L1, L2, SSIM
#
# A loss reaches the Gaussians only through its derivative with respect to the image. At the end of this chapter you
# know what that derivative looks like for the three losses of the method, why POP trades L1 for L2, and what the trade
# costs.

# %% [markdown]
# ## One pixel
#
# L1 averages $|\Delta|$ and L2 averages $\Delta^2$ over the $3HW$ numbers of an image, where
# $\Delta = c - c^{\mathrm{GT}}$ and GT is the photograph (the *ground truth*). The derivatives with respect to one of
# those numbers are (POP paper, eq. 4)
#
# $$\frac{\partial L_1}{\partial c} = \frac{\mathrm{sign}(\Delta)}{3HW},
# \qquad \frac{\partial L_2}{\partial c} = \frac{2 \Delta}{3HW} .$$
#
# {{source: pop_ref.losses.l2_vjp}}
#
# (A mask, where one is given, leaves pixels out; the means are then over the others.) L1 pulls equally hard at every
# error, L2 in proportion. In units of $1/(3HW)$ L1 pulls with 1; L2 with 2/255 at an error of one step of a byte, with
# 2 at the largest error there is, and with 1 at an error of 1/2.

# %%
from dataclasses import replace

import numpy as np

from pop_ref.losses import d_ssim, d_ssim_vjp, l1, l1_vjp, l2, l2_vjp, photometric_pop_vjp
from pop_ref.optimizer import adam_step, learning_rates
from pop_ref.polarization import pop_loss
from pop_ref.records import Camera, Gaussians
from pop_ref.render import render, render_vjp
from pop_ref.ssim import C1, C2
from pop_ref.training import gaussians_from_params, params_vjp
from pop_ref.walkthrough.bugs import caught
from pop_ref.walkthrough.pages import picture
from pop_ref.walkthrough.style import ACCENT, SECOND, THIRD, axes, show_image

# a picture of 256 x 1 px and one channel, each pixel a step more wrong; x 256 undoes the mean
errors = np.linspace(0.0, 1.0, 256)
wrong, right = errors[:, None, None], np.zeros((256, 1, 1))
pull_l1 = 256.0 * l1_vjp(wrong, right, 1.0).ravel()
pull_l2 = 256.0 * l2_vjp(wrong, right, 1.0).ravel()
assert np.array_equal(pull_l1, np.sign(errors))
np.testing.assert_allclose(pull_l2[[0, 1, -1]], [0.0, 2.0 / 255.0, 2.0])
assert np.array_equal(pull_l2[1:] > pull_l1[1:], errors[1:] > 0.5)

# %% [markdown]
# How good a picture is at the end is told by its *PSNR*, $-10 \log_{10} L_2$ in decibels (dB): 20 dB is an error of a
# tenth, 10 dB more is a tenth of the mean squared error, and halving every error adds 6 dB.
#
# ## Against a prior
#
# POP's argument is about what happens when something else pushes. Take one white splat over black at one pixel, so that
# the colour *is* its opacity $o$, a photograph of grey 0.2, and a *prior* $\lambda (1 - o)$, a term of the loss that
# does not look at the photograph and wants the splat opaque (the first term of eq. 8). Where does it come to rest?
#
# Under L1 it is all or nothing: below $\lambda = 1$ the prior does not move it at all, above it wins outright. Under L2
# the splat gives way by $\lambda / 2$ and is fully lost only at $\lambda = 1.6$: the more wrong, the stronger the pull
# back.

# %%
opacities = np.linspace(0.0, 1.0, 401)
priors = np.linspace(0.0, 2.0, 41)
grey = np.full((1, 1, 1), 0.2)


def rest_error(loss, weight):
    """Find how far from the photograph the splat comes to rest."""
    push = [weight * pop_loss(np.array([o]), np.array([True])) for o in opacities]
    pull = [loss(np.full((1, 1, 1), o), grey) for o in opacities]
    return opacities[np.argmin(np.add(push, pull))] - 0.2


rest_l1 = np.array([rest_error(l1, weight) for weight in priors])
rest_l2 = np.array([rest_error(l2, weight) for weight in priors])
undecided = np.isclose(priors, 1.0)
np.testing.assert_allclose(
    rest_l1[~undecided], np.where(priors < 1.0, 0.0, 0.8)[~undecided], atol=1e-9
)
np.testing.assert_allclose(rest_l2, np.minimum(priors / 2.0, 0.8), atol=1e-9)

fig, (left, right) = axes(2)
left.plot(errors[1:], pull_l1[1:], color=SECOND, label="L1")
left.plot(errors, pull_l2, color=ACCENT, label="L2")
left.set(xlabel="error of a colour", ylabel="pull, in 1 / (3HW)")
left.set(title="pull of a loss", ylim=(0.0, 2.1))
right.plot(priors[~undecided], rest_l1[~undecided], color=SECOND, label="L1")
right.plot(priors, rest_l2, color=ACCENT, label="L2")
right.set(xlabel=r"weight $\lambda$ of the prior", ylabel="error at rest")
right.set(title="a splat that a prior wants opaque")
for ax in (left, right):
    ax.legend()
picture(
    fig,
    "Left: eq. 4. Right: under L1 the splat keeps the photograph's grey up to a weight of 1 and is white beyond it; "
    "under L2 its error grows in proportion to the weight.",
)

# %% [markdown]
# Read the right picture both ways. L2 is the better opponent of a *strong* prior, because large errors pull up to twice
# as hard as under L1. Against a *weak* one L1 is better: it does not give way at all, and L2 always does a little.
# Under L2 the pull depends on how wrong a pixel is, under L1 it does not.

# %% [markdown]
# ### Exercise 1: predict
#
# A splat of one flat colour covers 100 pixels. In 90 of them the photograph is 0.2, in 10 it is 1 (a lamp). Which
# colour minimises L1, and which L2?

# %% answer
# L1: the median, 0.2, and the lamp is ignored however bright. L2: the mean, 0.28.
covered = np.array([0.2] * 90 + [1.0] * 10).reshape(10, 10, 1)
greys = np.linspace(0.0, 1.0, 101)
for loss, best in ((l1, 0.2), (l2, 0.28)):
    assert np.isclose(
        greys[np.argmin([loss(np.full_like(covered, c), covered) for c in greys])], best
    )

# %% [markdown]
# ## SSIM looks at windows
#
# *SSIM*, the structural similarity, compares means, variances and the covariance under a Gaussian window of 11 x 11 px
# (Wang et al. 2004, eq. 13; the D-SSIM of eqs. 2 and 9 is $1 - \mathrm{SSIM}$ in the programs of 3DGS and gsplat):
#
# $$S = \frac{(2 \mu_x \mu_y + C_1)(2 \sigma_{xy} + C_2)}{(\mu_x^2 + \mu_y^2 + C_1)(\sigma_x^2 + \sigma_y^2 + C_2)} .$$
#
# All of it is relative: a difference counts by what is there to compare it with. Between two flat patches only the
# first factor is left, and the same error of 0.1 costs some thirty times more in the dark than in the light. To L2 it
# is the same.

# %%
flat = np.ones((11, 11, 1))
dark, light = d_ssim(0.2 * flat, 0.1 * flat), d_ssim(0.9 * flat, 0.8 * flat)
print(f"an error of 0.1: D-SSIM {dark:.3f} in the dark, {light:.4f} in the light")
assert np.isclose(dark, 1.0 - (2 * 0.2 * 0.1 + C1) / (0.2**2 + 0.1**2 + C1))
assert 25.0 < dark / light < 35.0
assert np.isclose(l2(0.2 * flat, 0.1 * flat), l2(0.9 * flat, 0.8 * flat))

# %% [markdown]
# ### Exercise 2: derive
#
# The render has the photograph's brightness exactly but is flat, while the photograph has a texture of standard
# deviation $s$. What is S for $s = 0.03$ and for $s = 0.3$? What does that say about blur?

# %% answer
# Equal means make the first factor 1, and $\sigma_x = \sigma_{xy} = 0$ leave $C_2 / (s^2 + C_2)$: 1/2 at $s = 0.03$,
# the root of $C_2$, and 1/101 at 0.3. To lose even a faint texture costs half of all that SSIM has to give.
texture = np.where(np.indices((11, 11)).sum(axis=0) % 2 == 0, 1.0, -1.0)[:, :, None]
for s, similarity in ((0.03, 1 / 2), (0.3, 1 / 101)):
    assert np.isclose(C2 / (s**2 + C2), similarity)
    assert np.isclose(1.0 - d_ssim(0.5 * flat, 0.5 + s * texture), similarity, rtol=0.01)

# %% [markdown]
# ## Every opacity one
#
# Figure 3 of the paper shows a scene trained towards opacity 1, full of artifacts, and the three gradients there. The
# same in small: a wall of nearly opaque Gaussians carries a picture, and before it hangs haze, Gaussians of opacity
# under 0.15 (in the paper's figure 2 a third of a trained scene is under 0.1). The photograph is that scene; the render
# is the same scene with all opacities set to 1.

# %% setup
SIZE = 32
C0 = 0.28209479177387814


def painted(x, y):
    """Paint a sun over striped hills; x and y run over about [-1.5, 1.5], y down."""
    sky = np.stack([0.45 + 0.15 * y, 0.6 + 0.1 * y, 0.8 - 0.05 * y], axis=-1)
    sun = ((x - 0.6) ** 2 + (y + 0.6) ** 2 < 0.2)[..., None]
    hill = (y > 0.3 + 0.25 * np.sin(2.0 * x))[..., None]
    green = np.array([0.5, 1.0, 0.4])
    stripes = np.where(np.sin(7.0 * x + 3.0 * y) > 0.0, 0.45, 0.2)[..., None] * green
    return np.where(hill, stripes, np.where(sun, (0.95, 0.8, 0.3), sky))


def camera_of(size):
    """Look along z at what is painted, at depth 4."""
    K = np.array([[1.33 * size, 0, size / 2], [0, 1.33 * size, size / 2], [0, 0, 1.0]])
    return Camera(np.eye(4), K, size, size)


def splats_at(x, y, z, scales, opacities, noise):
    """Make round Gaussians there, painted; noise is added to the colours' coefficients."""
    means, quats = np.stack([x, y, z], axis=1), np.tile([1.0, 0.0, 0.0, 0.0], (len(x), 1))
    sh = ((painted(x, y) - 0.5) / C0 + noise)[:, None, :]
    return Gaussians(means, quats, np.tile(scales[:, None], (1, 3)), opacities, sh)


def wall(n):
    """Cover the picture with n x n nearly opaque Gaussians."""
    x, y = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-1.6, 1.6, n)] * 2))
    one = np.ones(n * n)
    return splats_at(x, y, 4.0 * one, 1.6 / n * one, 0.95 * one, 0.0)


def together(a, b):
    """Put two scenes into one."""
    return Gaussians(*(np.concatenate([vars(a)[name], vars(b)[name]]) for name in vars(a)))


# %%
rng = np.random.default_rng(6)
x, y = rng.uniform(-1.5, 1.5, (2, 40))
z, scales, faint = rng.uniform((3.0, 0.08, 0.03), (3.8, 0.2, 0.15), (40, 3)).T
scene = together(splats_at(x, y, z, scales, faint, rng.normal(0.0, 0.6, (40, 3))), wall(19))
photo = render(scene, camera_of(SIZE)).image
image = render(replace(scene, opacities=np.ones(len(scene))), camera_of(SIZE)).image
error = image - photo
pulls = {"L1": l1_vjp, "D-SSIM": d_ssim_vjp, "L2": l2_vjp}
pulls = {name: vjp(image, photo, 1.0) for name, vjp in pulls.items()}

fig, panels = axes(3, 2, height=4.7, ticks=False)
show_image(panels[0], photo, "photograph")
show_image(panels[1], image, "every opacity 1")
show_image(panels[2], np.abs(error).mean(axis=2), "error", vmin=0.0)
for ax, name in zip(panels[3:], pulls, strict=True):
    show_image(ax, np.abs(pulls[name]).mean(axis=2), f"|gradient| of {name}", vmin=0.0)
picture(
    fig,
    "The paper's figure 3 in small, each map scaled to its own maximum: blobs of haze, and the pull of each loss.",
)

# %% [markdown]
# L1's map is one flat tone: it says which way, never how far. L2's map is the error itself, doubled. SSIM's map is
# something else: where it is complete, away from the border, the sizes of gradient and error correlate weakly, by less
# than 0.7 here and for other draws of the haze (the paper says: no direct relation). That is its reason for L2,
# which alone of the three pulls in proportion to the error. (Here opacities are simply set; no prior is at work.)

# %%
assert np.ptp(np.abs(pulls["L1"])) == 0.0
np.testing.assert_allclose(pulls["L2"], 2.0 * error / (3 * SIZE * SIZE))
# ten pixels from the border on, all windows that hold a pixel lie inside the image
inner = np.s_[10:-10, 10:-10]
of_error, of_ssim = np.abs(error[inner]).ravel(), np.abs(pulls["D-SSIM"][inner]).ravel()
correlation = np.corrcoef(of_error, of_ssim)[0, 1]
print(f"correlation of the size of SSIM's gradient with the error: {correlation:.2f}")
assert 0.0 < correlation < 0.7

# %% [markdown]
# ## While a scene trains
#
# Figure 4a of the paper logs the mean size of each gradient during a training. Here is one by the oracle, on a picture
# of 20 x 20 px, with the photometric part of eq. 9,
#
# $$L = (1 - \lambda_{\mathrm{SSIM}})\, L_2 + \lambda_{\mathrm{SSIM}}\, L_{\mathrm{DSSIM}},
# \qquad \lambda_{\mathrm{SSIM}} = 0.01,$$
#
# and with learning rates five times the usual, so that 40 steps show something.

# %% setup
camera, target = camera_of(20), render(wall(15), camera_of(20)).image
rng = np.random.default_rng(7)
x, y = rng.uniform(-1.5, 1.5, (2, 50))
params = {
    "means": np.stack([x, y, rng.uniform(3.6, 4.4, 50)], axis=1),
    "quats": np.tile([1.0, 0.0, 0.0, 0.0], (50, 1)),
    "scales": np.full((50, 3), np.log(0.2)),
    "opacities": np.full(50, np.log(0.1 / 0.9)),
    "sh0": ((painted(x, y) - 0.5) / C0)[:, None, :],
}


def pulls_at(params, factor=1.0):
    """Pull the loss, times a factor, back to the image term by term, and to the Gaussians."""
    gaussians = gaussians_from_params(params)
    image = render(gaussians, camera).image
    terms = (
        l1_vjp(image, target, 1.0),
        l2_vjp(image, target, 1.0),
        d_ssim_vjp(image, target, 0.01),
    )
    v_image = photometric_pop_vjp(image, target, factor)
    np.testing.assert_allclose(v_image, factor * (0.99 * terms[1] + terms[2]), atol=1e-12)
    return terms, render_vjp(gaussians, camera, v_image)


# %%
rates = {name: 5.0 * rate for name, rate in learning_rates(0, 4.0).items()}
# the rotation of a round Gaussian has no gradient but rounding errors, which Adam would follow
rates["quats"] = 0.0
zero = {name: np.zeros_like(value) for name, value in params.items()}
moments = zero, zero
logged = []
for step in range(1, 41):
    terms, gradients = pulls_at(params)
    logged.append([np.sum(np.abs(term)) for term in terms])
    grads = params_vjp(params, gradients, np.zeros(50))
    params, *moments = adam_step(params, grads, *moments, step, rates)

size_l1, size_l2, size_ssim = np.array(logged).T
print("mean |gradient| at steps 1, 20, 40, in 1 / (3HW)")
for name, size in (("L1", size_l1), ("L2", size_l2), ("0.01 D-SSIM", size_ssim)):
    print(f"{name:12}", size[[0, 19, 39]].round(3))
fig, ax = axes(1, width=4.8, height=3.0)
ax.semilogy(size_l1, color=SECOND, label="L1")
ax.semilogy(size_l2, color=ACCENT, label="L2")
ax.semilogy(size_ssim, color=THIRD, label="0.01 D-SSIM")
ax.set(xlabel="step", ylabel="mean |gradient|, in 1 / (3HW)")
ax.legend(loc="center left", bbox_to_anchor=(0.6, 0.66))
picture(
    fig,
    "The paper's figure 4a in small: L1's pull never changes, L2's fades as the picture gets right.",
)

# %% [markdown]
# L1 pulls with 1 from the first step to the last; L2 begins at 0.73 and ends at less than a sixth of that. With its
# weight of 0.01, D-SSIM stays below L2 at every step and within a factor of three in the second half. With the 0.2 of
# the 3DGS objective (eq. 2) it would be twenty times larger, and drown L2. Hence the small $\lambda_{\mathrm{SSIM}}$ of
# eq. 9.
#
# The fading has a price. Density control, the rules that add and remove Gaussians (chapter 9), grows a Gaussian when
# its gradient exceeds a fixed threshold (eq. 3), and under L2 fewer do. [The next chapter](chapter_07_dominance.py)
# shows what POP adds.

# %%
assert np.allclose(size_l1, 1.0)
assert 0.6 < size_l2[0] < 0.85
assert size_l2[-1] < size_l2[0] / 6.0
assert np.all(size_ssim < size_l2)
assert np.all(size_l2[20:] < 3.0 * size_ssim[20:])
assert np.all(20.0 * size_ssim[20:] > 5.0 * size_l2[20:])

# %% [markdown]
# ### Exercise 3: predict
#
# Is L2 just a smaller L1? The paper divides L1 by $n$ to see. What changes if the whole loss is divided by 10: Adam's
# steps, the growth of eq. 3, the balance against a prior of fixed weight?

# %% answer
# Adam divides a gradient by its own running size, so its steps stay; the statistic of eq. 3 falls tenfold
# against its fixed threshold, so fewer Gaussians grow; the prior gains tenfold.
(_, whole), (_, tenth) = pulls_at(params), pulls_at(params, 0.1)
one, other = (
    adam_step(params, params_vjp(params, gradients, np.zeros(50)), zero, zero, 1, rates)[0]
    for gradients in (whole, tenth)
)
for name in params:
    assert np.allclose(one[name], other[name], rtol=1e-6, atol=1e-9)
assert np.allclose(tenth.means2d, 0.1 * whole.means2d, rtol=1e-9, atol=1e-15)
assert (rest_error(l1, 0.5), rest_error(lambda *both: 0.1 * l1(*both), 0.5)) == (0.0, 0.8)

# %% [markdown]
# ### Exercise 4: code
# A *held-out* view is one that was put aside and not trained on, as in chapter 0. Its quality is told as PSNR. Write
# it. What does the same error of a tenth give everywhere, and what does halving
# every error gain? What happens if only one pixel in a hundred is wrong, by 1?


# %% answer
# 20 dB; 6.02 dB, whatever the errors are; and 20 dB again: PSNR does not tell a slight error everywhere from a gross
# one in a few places.
def psnr(image, target):
    return -10.0 * np.log10(l2(image, target))


black = np.zeros((10, 10, 3))
spot = black.copy()
spot[0, 0] = 1.0
print(*(f"{psnr(image, black):.2f} dB" for image in (black + 0.1, black + 0.05, spot)))
assert np.isclose(psnr(black + 0.1, black), 20.0)
assert np.isclose(psnr(black + 0.05, black) - 20.0, 6.0206, atol=1e-4)
assert np.isclose(psnr(spot, black), 20.0)

# %% [markdown]
# ### Exercise 5: find the bug
# Many textbooks write the loss like this. Why is it wrong here, although its minimum is the same?
#
# {{bug: halved_l2}}

# %% answer
# It is half of the mean square. Alone that would not matter; next to SSIM and the prior, whose weights are fixed, it
# shifts the balance by two (eq. 9), and eq. 3 compares its gradients with a fixed threshold.
print(caught("halved_l2"))
