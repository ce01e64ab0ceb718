# minutes: 25

# %% [markdown]
# # 4. Compositing and early ray termination
#
# A pixel usually sees dozens of splats, one behind the other. At the end of this chapter you know how their colours add
# up, why their order matters, when a renderer may stop looking, and why opaque splats make it fast.
#
# ## Light that is left
#
# Walk from the eye into the scene, splat by splat, and keep one number: the *transmittance* $T$, the share of light
# that gets through everything so far. It starts at 1, and each splat lets $1 - \alpha$ of it pass. What a splat
# contributes is its colour, times its alpha, times what still reaches it:
#
# $$C = \sum_{i=1}^{m} T_i\, \alpha_i\, c_i + T_{m+1}\, b, \qquad T_1 = 1, \quad T_{i+1} = T_i (1 - \alpha_i)$$
#
# This is POP paper, eq. 1, with a background $b$ behind it. Written as a loop it is five lines. The oracle's loop does
# the same, and also keeps what the backward pass will need, skips what is under the floor, and stops (below):
#
# {{source: pop_ref.pixel.composite_pixel}}

# %%
import math
from dataclasses import replace

import numpy as np

from pop_ref.constants import PAPER
from pop_ref.pixel import SplatRows, composite_pixel, stops
from pop_ref.records import Camera, Gaussians
from pop_ref.render import render
from pop_ref.walkthrough.bugs import caught
from pop_ref.walkthrough.pages import picture
from pop_ref.walkthrough.style import ACCENT, INK, SECOND, THIRD, axes, show_image


def blend(alphas: np.ndarray, colors: np.ndarray, background: np.ndarray) -> np.ndarray:
    color, T = np.zeros(3), 1.0
    for alpha, c in zip(alphas, colors, strict=True):
        color += T * alpha * c
        T *= 1 - alpha
    return color + T * background


def stack(alphas: np.ndarray, colors: np.ndarray) -> SplatRows:
    """Put splats right over one pixel centre, (0.5, 0.5), where alpha is the opacity."""
    n = len(alphas)
    return SplatRows([[0.5, 0.5]] * n, [[1.0, 0.0, 1.0]] * n, alphas.tolist(), colors.tolist())


rng = np.random.default_rng(4)
alphas, colors = rng.uniform(0.05, 0.7, 6), rng.uniform(0, 1, (6, 3))
background = np.array([1.0, 1.0, 0.9])
pixel = composite_pixel(range(6), stack(alphas, colors), 0.5, 0.5, background.tolist())
print("alphas       ", alphas.round(2))
print("transmittance", np.round(pixel.transmittances, 2))
print("weights      ", np.round(pixel.weights, 2), " left:", round(pixel.T_final, 2))
assert np.allclose(pixel.color, blend(alphas, colors, background))

# %% [markdown]
# ## The weights are a partition of the light
#
# The *weight* of a splat is $w_i = T_i \alpha_i = T_i - T_{i+1}$, the light that it takes. Adding up, the sum
# telescopes: all weights and the light that is left make exactly 1,
#
# $$\sum_{i=1}^{m} T_i \alpha_i + T_{m+1} = 1,$$
#
# so a pixel is an average of colours, and never brighter than the brightest of them. The splat of the largest weight is
# the pixel's *dominant* Gaussian (POP paper, eq. 5), which matters from chapter 7 on.

# %%
assert np.isclose(sum(pixel.weights) + pixel.T_final, 1)
assert np.allclose(pixel.weights, -np.diff([*pixel.transmittances, pixel.T_final]))

# %% [markdown]
# The order decides. The same six splats from back to front give another pixel (exercise 1 says how much a swap of two
# neighbours costs). A renderer therefore sorts splats by depth before it blends. It need not go from front to back,
# though: a painter's rule, $b_{i-1} = \alpha_i c_i + (1 - \alpha_i)\, b_i$ from the background $b_m = b$ forward, gives
# the same. But only the walk from the front knows when to stop.

# %%
assert not np.allclose(blend(alphas[::-1], colors[::-1], background), pixel.color, atol=0.01)

behind = background
for alpha, c in zip(alphas[::-1], colors[::-1], strict=True):
    behind = alpha * c + (1 - alpha) * behind
assert np.allclose(behind, pixel.color)

# %% [markdown]
# ## When to stop
#
# Once hardly any light is left, what lies behind cannot be seen. *Early ray termination* ends a pixel before the splat
# that would take the transmittance to
#
# $$T_{i+1} \le 10^{-4}$$
#
# (POP paper, section 3.1; decision D7). How soon that happens depends on alpha alone: $n$ equal splats leave $(1 -
# \alpha)^n$.

# %%
assert PAPER.transmittance_stop == 1e-4
assert stops(1e-4)
assert not stops(1.01e-4)


def visited(alpha: float) -> int:
    """Count the splats that a pixel looks at before it ends, in an endless row of equal ones."""
    endless = stack(np.full(500, alpha), np.ones((500, 3)))
    return composite_pixel(range(500), endless, 0.5, 0.5, [0.0] * 3).n_traversed


needed = {alpha: visited(alpha) for alpha in (0.05, 0.1, 0.3, 0.5, 0.8, 0.95)}
for alpha, n in needed.items():
    assert (1 - alpha) ** n <= 1e-4 < (1 - alpha) ** (n - 1)
assert needed[0.1] == 88
assert needed[0.8] == 6
print("visited, by alpha:", needed)

fig, ax = axes(height=2.8)
steps = np.arange(0, 61)
for alpha, shade in ((0.1, ACCENT), (0.3, SECOND), (0.8, THIRD)):
    T = (1 - alpha) ** steps
    alive = T > 1e-4
    ax.plot(steps[alive], T[alive], ".-", ms=4, lw=1, color=shade, label=rf"$\alpha$ = {alpha}")
ax.axhline(1e-4, color=INK, lw=0.8)
ax.annotate("stop", (60, 1e-4), (-4, 4), textcoords="offset points", ha="right")
ax.set(yscale="log", ylim=(3e-5, 1.4), xlim=(0, 60))
ax.set(xlabel="splats passed", ylabel="transmittance $T$")
ax.legend(loc="upper right")
picture(
    fig,
    "Light left behind a row of equal splats. With alpha 0.1 a pixel looks at 88 of them, with 0.8 at 6.",
)

# %% [markdown]
# One detail is worth knowing. In the rasterizers of 3DGS and gsplat, and so in POP, the splat that would cross the line
# is *not blended*: the pixel ends in front of it. (Faster-GS and LiteGS do blend it before they stop.) If that splat is
# nearly opaque, a good share of the light is lost. Put one splat of alpha 0.91 before a wall of alpha 0.999. It leaves
# $T = 0.09$, the wall would leave $9 \cdot 10^{-5}$, so the wall is skipped, and nine percent of the pixel shows the
# background instead.

# %%
veil_and_wall = stack(np.array([0.91, 0.999]), np.array([[0.2, 0.2, 0.2], [0.0, 0.5, 1.0]]))
odd = composite_pixel([0, 1], veil_and_wall, 0.5, 0.5, background.tolist())
print(f"looked at {odd.n_traversed}, blended {odd.ids}, light left {odd.T_final:.2f}")
assert odd.ids == [0]
assert odd.n_traversed == 2
assert np.isclose(odd.T_final, 0.09)
assert np.allclose(odd.color, 0.91 * np.array([0.2, 0.2, 0.2]) + 0.09 * background)

# %% [markdown]
# Here you can rearrange the splats of one pixel. The last column is the subject of chapter 5.
#
# {{widget: stack}}
#
# ## A whole image
#
# `render` does for every pixel what we did for one: project, list the splats by depth, blend, stop. Here is a box full
# of Gaussians, rendered twice. All that differs is opacity, once 0.2, once 0.98. The opaque ones end rays early, and
# the renderer visits less than half as many splats.

# %%
K = np.array([[40.0, 0.0, 24.0], [0.0, 40.0, 16.0], [0.0, 0.0, 1.0]])
camera = Camera(np.eye(4), K, 48, 32)


def box_of(count: int, opacity: float) -> Gaussians:
    """Fill a box with Gaussians, the same ones for the same count."""
    rng = np.random.default_rng(5)
    numbers = rng.uniform(size=(count, 6))
    turns_and_tints = rng.normal(size=(count, 7))
    return Gaussians(
        means=numbers[:, :3] * [3.2, 2.2, 3.0] + [-1.6, -1.1, 3.0],
        quats=turns_and_tints[:, :4],
        scales=0.08 + 0.37 * numbers[:, 3:],
        opacities=np.full(count, opacity),
        sh=1.1 * turns_and_tints[:, None, 4:],
    )


white = np.ones(3)
views = [render(box_of(600, o), camera, white, tile_size=4) for o in (0.2, 0.98)]
for view in views:
    assert view.image.max() <= max(1.0, view.splats.colors.max()) + 1e-12
soft, hard = (view.n_traversed.mean() for view in views)
assert hard < 0.5 * soft
print(f"splats visited per pixel: {soft:.0f} and {hard:.0f}")

# where few lie behind each other no ray ends early, and opaque ones reach farther
sparse = [render(box_of(60, o), camera, white, tile_size=4) for o in (0.2, 0.98)]
assert sparse[0].n_traversed.mean() < sparse[1].n_traversed.mean()

fig, panels = axes(3, 2, height=3.9, ticks=False)
most = max(view.n_traversed.max() for view in views)
for row, (view, name) in enumerate(zip(views, ("opacity 0.2", "opacity 0.98"), strict=True)):
    image, light, visits = panels[3 * row : 3 * row + 3]
    show_image(image, view.image, name)
    left = show_image(light, view.T_final, "light left", vmin=0, vmax=1)
    seen = show_image(visits, view.n_traversed, "splats visited", vmin=0, vmax=most)
    fig.colorbar(left, ax=light, shrink=0.8)
    fig.colorbar(seen, ax=visits, shrink=0.8)
picture(
    fig,
    "The same 600 Gaussians, faint and nearly opaque. Opaque ones hide each other, and rays end early.",
)

# %% [markdown]
# This is half of the idea of POP. A faint Gaussian costs a visit at every pixel that it covers and ends no ray. If
# every Gaussian that matters were driven to opacity 1 and every other to 0, the others could be thrown away, and rays
# would end soon behind the first surface. Chapters 7 and 8 do that.

# %% [markdown]
# ### Exercise 1: derive
# Two neighbours with alphas $\alpha_1, \alpha_2$ and colours $c_1, c_2$ lie behind a transmittance $T$. By how much
# does the pixel change when they swap places?

# %% answer
# In front a colour loses nothing; behind, it loses the share that the other takes. What lies behind both sees the same
# light. So the change is $T \alpha_1 \alpha_2 (c_2 - c_1)$: second order in alpha, and zero for equal colours.
swapped = [0, 1, 3, 2, 4, 5]
change = blend(alphas[swapped], colors[swapped], background) - pixel.color
T = pixel.transmittances[2]
assert np.allclose(change, T * alphas[2] * alphas[3] * (colors[3] - colors[2]))

# %% [markdown]
# ### Exercise 2: predict
# A pixel looks into an endless row of splats of alpha 0.2. How many does it visit, by formula and by loop?

# %% answer
# The least $n$ with $0.8^n \le 10^{-4}$: $n = \lceil \ln 10^{-4} / \ln 0.8 \rceil = 42$.
assert math.ceil(math.log(1e-4) / math.log(0.8)) == 42 == visited(0.2)

# %% [markdown]
# ### Exercise 3: derive
# What is the largest share of light that the stop can throw away, given the ceiling of 0.999? And if the ceiling is
# 0.99, as in gsplat 1.6?

# %% answer
# The skipped splat has $T (1 - \alpha) \le 10^{-4}$, so $T \le 10^{-4} / (1 - \alpha)$: a tenth of the light under a
# ceiling of 0.999, a hundredth under 0.99. The veil of 0.91 above came close to the worst case.
for ceiling, most in ((0.999, 0.1), (0.99, 0.01)):
    profile = replace(PAPER, alpha_ceiling=ceiling)
    lost = []
    for veil in np.linspace(0.5, ceiling, 2000):
        three = stack(np.array([0.5, veil, 1.0]), np.ones((3, 3)))
        ended = composite_pixel(range(3), three, 0.5, 0.5, [0.0] * 3, profile)
        lost.append(ended.T_final if len(ended.ids) == 2 else 0.0)
    assert 0.9 * most < max(lost) <= most

# %% [markdown]
# ### Exercise 4: code
# Blend a list in two halves, each by itself over black, and put the halves together. Which numbers of each half do you
# need? (This is how a long list is shared among workers.)


# %% answer
# Colour and transmittance of each: $C = C_1 + T_1 C_2$ and $T = T_1 T_2$. Blending is associative, like the product of
# matrices, though not commutative. Only the stop spoils it, since the second half does not know what the first has
# left.
def part(ids: range) -> tuple[np.ndarray, float]:
    half = composite_pixel(ids, stack(alphas, colors), 0.5, 0.5, [0.0] * 3)
    return np.array(half.color), half.T_final


(first, T_1), (second, T_2) = part(range(3)), part(range(3, 6))
print((first + T_1 * second + T_1 * T_2 * background).round(6), np.round(pixel.color, 6))
assert np.allclose(first + T_1 * second + T_1 * T_2 * background, pixel.color)

# %% [markdown]
# ### Exercise 5: find the bug
# Compare this loop with the oracle's. For which pixels does it give another colour?
#
# {{bug: terminating_splat_blended}}

# %% answer
# `stops` is asked about $T$ before the splat and not about the light that the splat would leave. So the splat that
# crosses the line is blended, and the pixel ends at the next one.
# Every pixel that stops gets more light, by the weight $T \alpha$ of that splat. Since $T (1 - \alpha) \le 10^{-4}$,
# this is at most $10^{-4} \alpha / (1 - \alpha)$: no more than $10^{-4}$ up to an alpha of one half, but up to a tenth
# under the ceiling of 0.999, as for the wall above. Two programs do it on purpose; one that is compared with gsplat
# must not.
for last, most in ((0.5, 1e-4), (0.9, 9e-4), (0.999, 0.0999)):
    lights = 10.0 ** rng.uniform(-4, 0, 1000)
    ending = lights[lights * (1 - last) <= 1e-4]
    assert np.max(ending * last, initial=0.0) <= 1e-4 * last / (1 - last) < 1.001 * most
print(caught("terminating_splat_blended"))
