# minutes: 15

# %% [markdown]
# # 0. The whole thing in one picture
#
# Some photographs of a scene go in, and out comes a model of the scene that can be looked at from anywhere, in real
# time. This chapter shows every step once, on one small scene, without a formula. The chapters after it take the steps
# one by one, until you could write all of it yourself.
#
# ## Photographs
#
# The scene is a still life of toys. It is made up and ray-traced by this package, so that every reader has it: `pop
# demo` makes it in any size. Sixteen photographs are taken from around it, of 80 by 60 pixels, small enough that all of
# this page can be computed while it is made. One of them is put aside and never trained on, to judge the result by.

# %%
import tempfile
from importlib.resources import files
from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.patches import FancyBboxPatch

from pop_fast.data import load_capture
from pop_fast.demo import make_demo
from pop_ref.learn import splat
from pop_ref.walkthrough.builder.glossary import STAGES, shapes
from pop_ref.walkthrough.pages import picture
from pop_ref.walkthrough.style import ACCENT, INK, MUTED, SECOND, axes, show_image

WIDTH, HEIGHT, UNSEEN = 80, 60, 8
with tempfile.TemporaryDirectory() as folder:
    make_demo(Path(folder) / "demo", views=16, width=WIDTH, height=HEIGHT)
    capture = load_capture(Path(folder) / "demo")
photographs = [view.image / 255.0 for view in capture.views]
cameras = [(view.viewmat, view.K, WIDTH, HEIGHT) for view in capture.views]
seen = [k for k in range(16) if k != UNSEEN]

fig, panels = axes(4, height=1.6, ticks=False)
for panel, k in zip(panels, (0, 4, 12, UNSEEN), strict=True):
    show_image(panel, photographs[k], "put aside" if k == UNSEEN else f"photograph {k}")
picture(fig, "Four of the sixteen photographs. The last is not trained on.")

# %% [markdown]
# ## Points
#
# From photographs alone, a program such as COLMAP finds where each was taken, and a sparse cloud of points that several
# of them show. That is where everything starts (chapter 9b). Ours comes with the demo: well over a thousand points,
# each with a position and a colour.

# %%
points, tints = capture.points, capture.points_rgb / 255.0
assert 1000 < len(points) < 4000
print(
    f"{len(points)} points; the first: position {points[0].round(3)}, colour {tints[0].round(2)}"
)


def seen_by(k, where):
    """Find where a photograph shows points: px, and their depths."""
    viewmat, K, *_ = cameras[k]
    p = where @ viewmat[:3, :3].T + viewmat[:3, 3]
    return (p @ K.T)[:, :2] / p[:, 2:], p[:, 2]


fig, (left, right) = axes(2, height=2.9, ticks=False)
at, depths = seen_by(UNSEEN, points)
order = np.argsort(-depths)
# so many dots are kept as an image
left.scatter(*at[order].T, s=7, c=tints[order], lw=0, rasterized=True)
left.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0), aspect="equal")
left.set(title="the points, from the side put aside")
right.scatter(*points[:, :2].T, s=4, c=tints, lw=0, rasterized=True)
places = np.array([-camera[0][:3, :3].T @ camera[0][:3, 3] for camera in cameras])
right.plot(*places[seen, :2].T, "^", color=ACCENT, ms=5)
right.plot(*places[UNSEEN, :2], "^", color=SECOND, ms=7)
right.set(aspect="equal", title="and from above, with the cameras")
right.set(xlim=(-1.6, 1.6), ylim=(-1.3, 1.3))
picture(
    fig,
    "All that training begins with. Triangles: the cameras; orange: the photograph put aside.",
)

# %% [markdown]
# ## Splats
#
# Now the idea. Put at each point a *Gaussian*: a small soft ellipsoid of coloured fog, densest in the middle, fading
# outwards. It has a place (3 numbers), a shape (three widths, and a rotation of 4 numbers), a colour (3 numbers here,
# 48 when it may change with the direction of view), and an opacity (1). Seen through a camera it is a soft ellipse on
# the screen, a *splat*. Paint all splats on top of each other in the order of their depth, and that is the picture.
#
# At first it is a blur: how large, how opaque and how turned each Gaussian should be is not known yet.

# %% setup
rng = np.random.default_rng(0)
# points that lie closer together than this add little here
picked = []
for i in rng.permutation(len(points)):
    if np.all(np.sum((points[i] - points[picked]) ** 2, axis=1) > 0.018**2):
        picked.append(i)
to_others = np.sum((points[picked][:, None] - points[picked]) ** 2, axis=2)
apart = np.sqrt(np.mean(np.sort(to_others, axis=1)[:, 1:4], axis=1))
n = len(picked)
background = np.array([0.55, 0.62, 0.5])
params = {
    "means": points[picked],
    "quats": np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
    "scales": np.tile(np.log(0.5 * apart)[:, None], (1, 3)),
    "opacities": np.full(n, -0.5),
    "sh0": ((tints[picked] - 0.5) / splat.SH_C0)[:, None],
}
# what training begins with; it makes new arrays
started = dict(params)


def drawn(params, k=UNSEEN):
    """Render the Gaussians as camera k sees them."""
    return splat.render(params, cameras[k], background)[0]


def psnr(image, photograph):
    """Compare two pictures, in decibels: 10 more is a tenth of the mean squared error."""
    return -10.0 * np.log10(splat.l2(np.clip(image, 0.0, 1.0), photograph)[0])


# %%
small = {**params, "scales": params["scales"] - np.log(3.0), "opacities": np.full(n, 4.0)}
print(f"{n} Gaussians of 14 numbers each: {14 * n} numbers")

fig, (left, right) = axes(2, height=2.9, ticks=False)
show_image(left, drawn(small), "the Gaussians, a third as wide and opaque")
show_image(right, drawn(params), "the Gaussians as they are")
picture(fig, "The same Gaussians twice, from the side that is put aside, before any training.")

# %% [markdown]
# ## Training
#
# *Training* makes it sharp, and it is one loop:
#
# 1. **Render** the Gaussians as one of the photographs' cameras sees them.
# 2. **Compare**: the *loss* is one number that says how far picture and photograph are apart.
# 3. **Differentiate**: for each of the 14 numbers of each Gaussian, find whether the loss falls when it grows a little.
#    This is the *gradient*. That it can be computed, for all numbers at once, is the heart of the method.
# 4. **Step**: change each number a little in the direction that lowers the loss.
#
# Here the loop runs in front of you, in this page: three balls on a chequered floor, photographed from 24 sides at 64
# by 64 pixels, and 300 grey Gaussians that know nothing yet. Right is the same training with the prior that this
# walk-through is about; it is explained later. The numbers under a picture say how like the photograph it is (PSNR, in
# decibels; larger is better) and how opaque the Gaussians are.
#
# {{widget: train}}
#
# The page does what `pop_ref/learn/splat.py` does, the whole method in 300 lines of NumPy. Run it on your machine
# (`python -m pop_ref.learn.splat`), or in this page, which fetches a Python for browsers if you ask it to.
#
# {{widget: python}}
#
# With its functions the loop is short. Here it takes seventy turns on our still life:

# %%
STEPS = 70
rates = {"means": 3e-3, "quats": 2e-2, "scales": 4e-2, "opacities": 8e-2, "sh0": 3e-2}
m, v = ({name: np.zeros_like(x) for name, x in params.items()} for _ in range(2))
first = psnr(drawn(params), photographs[UNSEEN])
for step in range(STEPS):
    k = seen[int(rng.integers(len(seen)))]
    image, tape = splat.render(params, cameras[k], background)
    loss, v_image = splat.l2(image, photographs[k])
    gradients, _ = splat.render_vjp(params, tape, v_image)
    now = {name: 0.2 ** (step / STEPS) * rate for name, rate in rates.items()}
    splat.adam_step(params, gradients, m, v, step + 1, now)
last = psnr(drawn(params), photographs[UNSEEN])
print(f"the side put aside: {first:.1f} dB before, {last:.1f} dB after {STEPS} steps")
assert last > first + 1.5

# %%
fig, panels = axes(3, height=2.0, ticks=False)
show_image(panels[0], photographs[UNSEEN], "the photograph")
show_image(panels[1], drawn(params), "the Gaussians")
small = {**params, "scales": params["scales"] - np.log(3.0), "opacities": np.full(n, 4.0)}
show_image(panels[2], drawn(small), "a third as wide, opaque")
picture(
    fig,
    "After seventy steps. The Gaussians have found their sizes and turned into the surfaces.",
)

# %% [markdown]
# Seventy steps leave a blur. The same toys, in photographs four times as wide, were trained for 3,000 steps before this
# page was made. (`make demo` trains on those photographs for a minute.) Gaussians were added where they were needed,
# and removed where they were not. The view is again one that no step has seen.

# %%
kept = plt.imread(str(files("pop_ref.walkthrough") / "trained.png"))[..., :3]
trained, photographed = np.split(kept, 2, axis=1)
print(f"after 3,000 steps: {psnr(trained, photographed):.1f} dB; after seventy: {last:.1f} dB")
assert last + 5.0 < psnr(trained, photographed) < 50.0

fig, panels = axes(2, height=2.3, ticks=False)
show_image(panels[0], trained, "the Gaussians after 3,000 steps")
show_image(panels[1], photographed, "the photograph")
picture(
    fig,
    "A real training takes 30,000 steps on large photographs, and ends with hundreds of thousands of Gaussians.",
)

# %% [markdown]
# ## The map
#
# The loop, taken apart into its stages. Every stage is one small file of `pop_ref`, the *oracle*: the method in plain
# NumPy, every function with its equation and its source. The shapes are those of the arrays that pass from stage to
# stage: N Gaussians, an image of H by W pixels. What goes down as values comes back up as gradients, in the reverse
# order (chapters 5 and 5b).

# %%
fig, ax = axes(1, height=5.6)
arrow = {"arrowstyle": "->"}
for row, stage in enumerate(STAGES):
    y = -row
    kind = ACCENT if row < 8 else SECOND
    box = FancyBboxPatch(
        (0.0, y - 0.32), 2.0, 0.64, boxstyle="round,pad=0.03", fc="none", ec=kind, lw=1.4
    )
    ax.add_patch(box)
    ax.text(1.0, y, stage.title, ha="center", va="center", color=INK)
    given = "loss, gradients" if stage.gives == ("v_x",) else shapes(stage.gives)
    ax.text(2.2, y, f"→ {given}", va="center", color=INK)
    ax.text(
        9.2, y, f"chapter {stage.chapter}", va="center", ha="right", color=MUTED, fontsize=8
    )
    if row + 1 < len(STAGES):
        ax.annotate("", (1.0, y - 0.66), (1.0, y - 0.36), arrowprops={**arrow, "color": MUTED})
back = {**arrow, "color": SECOND, "lw": 1.4, "connectionstyle": "bar,fraction=-0.03"}
ax.annotate("", (-0.25, 0.0), (-0.25, 1.0 - len(STAGES)), arrowprops=back)
ax.text(-0.85, -5.5, "one step later", rotation=90, va="center", color=SECOND)
ax.set(xlim=(-1.1, 9.3), ylim=(0.6 - len(STAGES), 0.6))
ax.axis("off")
picture(
    fig,
    "Blue: rendering. Orange: learning. Each stage takes what is above it, and the parameters.",
)

# %% [markdown]
# {{stages}}
#
# ## What POP changes
#
# A trained scene is full of Gaussians that are barely visible, and every pixel must go through dozens of them. The
# *Polarized Opacity Prior* (POP) is a small addition to the loop that drives the opacity of each Gaussian to one of two
# poles: 1 if some pixel needs it more than any other, else 0. What reaches 0 is removed; what reaches 1 hides what is
# behind it, so that a pixel is done sooner.
#
# | step | 3D Gaussian Splatting | with POP | chapter |
# |---|---|---|---|
# | compare | L1 and SSIM | L2 and a little SSIM, and the prior | 6, 8 |
# | make more Gaussians | where gradients are large | also where one wins too many pixels | 7, 9 |
# | remove Gaussians | reset opacities at times, remove the faint | no reset; remove what the prior drives to 0 | 8, 9 |
#
# In the paper's ablation on Mip-NeRF 360 a model trained with all of POP ends with 268 thousand Gaussians, and one that
# lacks the prior alone with 583 thousand. The prior costs 0.2 dB there.
#
# ## What to know before, and how long it takes
#
# Vectors, matrices, eigenvalues, and the chain rule; Python and a little NumPy. Nothing about graphics or learning.
# Chapters 10 and 11 need torch, the others do not.
#
# {{chapters}}
#
# Short of time? 0, 1, 2, 4, 5 and 8 make a lecture. To learn by doing, `pop learn start mine` writes 13 files with
# empty functions and judges what you write into them, stage by stage (`pop learn check alpha`).
#
# ## The papers
#
# - Kerbl, Kopanas, Leimkühler, Drettakis: [3D Gaussian Splatting for Real-Time Radiance Field
#   Rendering](https://arxiv.org/abs/2308.04079), 2023. Here "3DGS".
# - Wang et al.: *Fast and Compact 3D Gaussian Splatting with Polarized Opacity Prior*. Here "the POP paper", whose
#   equations are cited as "POP paper, eq. 1", and so on.
# - Zwicker, Pfister, van Baar, Gross: *EWA Volume Splatting*, 2001: how an ellipsoid is projected.
# - Fang, Wang: [Mini-Splatting](https://arxiv.org/abs/2403.14166), 2024: the blur rule.
# - Ye et al.: [gsplat](https://arxiv.org/abs/2409.06765), 2024: the library that most of today's programs are built on.
# - Kingma, Ba: [Adam](https://arxiv.org/abs/1412.6980), 2015.

# %% [markdown]
# ### Exercise 1: predict
# Before it was trained, the scene's Gaussians were put at the points and had their colours. Which of the five kinds of
# numbers (place, widths, rotation, opacity, colour) do you expect to have changed most by the end, measured in steps of
# its learning rate?

# %% answer
# The opacities and the colours. A point cloud says nothing of opacities, and a point's colour is that of single pixels,
# while a splat's must suit all that it covers. The places, which a point cloud knows best, and the rotations change
# least.
moved = {name: np.mean(np.abs(params[name] - started[name])) / rates[name] for name in params}
print({name: f"{x:.1f} steps" for name, x in moved.items()})
assert {"opacities", "sh0"} == set(sorted(moved, key=lambda name: moved[name])[-2:])
assert {"means", "quats"} == set(sorted(moved, key=lambda name: moved[name])[:2])

# %% [markdown]
# ### Exercise 2: derive
# How many numbers are in the fifteen photographs, and how many in the Gaussians? Is it surprising that the photographs
# decide them?

# %% answer
# $15 \cdot 80 \cdot 60 \cdot 3 = 216{,}000$ against 14 a Gaussian, fewer than twenty thousand: each number has to suit
# some thirteen measurements. Where a surface is seen by few photographs, though, many answers suit them equally well.
numbers = sum(x.size for x in params.values())
print(15 * HEIGHT * WIDTH * 3, numbers)
assert numbers == 14 * n < 20_000
assert 11 < 216_000 / numbers < 14
assert 15 * HEIGHT * WIDTH * 3 == 216_000
