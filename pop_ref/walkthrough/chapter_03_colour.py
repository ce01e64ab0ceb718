# minutes: 25

# %% [markdown]
# # 3. Colour from harmonics
#
# A Gaussian looks different from different sides, as a real surface does. At the end of this chapter you can read the
# 48 numbers that hold its colour: what spherical harmonics are, how they become a colour, and what they can and cannot
# show.
#
# ## A function on the sphere
#
# The colour $c_i$ of POP paper, eq. 1, is no constant. It depends on the direction $d$ from the camera to the Gaussian,
# and a function of direction is a function on the unit sphere. 3DGS (section 4) writes it in *spherical harmonics*, the
# sphere's counterpart of a Fourier series:
#
# $$c(d) = \max\left( \tfrac{1}{2} + \sum_{k} Y_k\!\left(\tfrac{d}{|d|}\right) h_k, \; 0 \right)$$
#
# The $Y_k$ are fixed polynomials of the direction, up to degree 3 here: one of degree 0, three of degree 1, five of
# degree 2, seven of degree 3. The $h_k$ are the Gaussian's own, three numbers each, one per colour channel. The offset
# of a half makes a Gaussian without coefficients grey. Here are all sixteen, for a unit vector $(x, y, z)$:
#
# {{source: pop_ref.harmonics._basis_one}}
#
# with these constants, which make the mean of each square over the sphere the same:
#
# | constant | | | constant | | |
# |---|---|---|---|---|---|
# | `_C0` | $\sqrt{1/4\pi}$ | 0.2821 | `_C3_3` | $\sqrt{35/32\pi}$ | 0.5900 |
# | `_C1` | $\sqrt{3/4\pi}$ | 0.4886 | `_C3_2` | $\sqrt{105/4\pi}$ | 2.8906 |
# | `_C2` | $\sqrt{15/4\pi}$ | 1.0925 | `_C3_1` | $\sqrt{21/32\pi}$ | 0.4570 |
# | `_C2_Z` | $\sqrt{5/16\pi}$ | 0.3154 | `_C3_0` | $\sqrt{7/16\pi}$ | 0.3732 |
#
# Mind the signs of degree 1, $(-y, z, -x)$: programs that leave them
# out make scenes whose highlights wander to the wrong side in every other program. The colour is then
#
# {{source: pop_ref.harmonics.colors_from_sh}}

# %%
import math

import numpy as np

from pop_ref import harmonics
from pop_ref.harmonics import colors_from_sh, sh_basis
from pop_ref.optimizer import sh_degree_at
from pop_ref.records import Camera, Gaussians
from pop_ref.render import render
from pop_ref.walkthrough.bugs import caught
from pop_ref.walkthrough.pages import picture
from pop_ref.walkthrough.style import (
    ACCENT,
    DIVERGING,
    INK,
    MUTED,
    SECOND,
    THIRD,
    axes,
    show_image,
)

names = ("_C0", "_C1", "_C2", "_C2_Z", "_C3_3", "_C3_2", "_C3_1", "_C3_0")
over_pi = (1 / 4, 3 / 4, 15 / 4, 5 / 16, 35 / 32, 105 / 4, 21 / 32, 7 / 16)
for name, square in zip(names, over_pi, strict=True):
    assert math.isclose(getattr(harmonics, name), math.sqrt(square / math.pi))
for degree in range(4):
    assert sh_basis(np.eye(3)[:1], degree).shape == (1, (degree + 1) ** 2)
grey = colors_from_sh(np.zeros((1, 16, 3)), np.array([[1.0, 2.0, 3.0]]), degree=3)
assert np.array_equal(grey, [[0.5, 0.5, 0.5]])

# %% [markdown]
# Here they are. Each globe shows one $Y_k$: at a point of the globe stands its value for the camera that looks at this
# point from outside. So $d$ runs inwards, and in the middle it is $(0, 0, 1)$, the way in which a camera in front
# looks. Blue is positive, orange negative. The first is constant, the next three divide the sphere in halves, and so on
# to finer and finer patterns.

# %%
side = np.linspace(-1, 1, 64)
right, down = np.meshgrid(side, side)
on_globe = right**2 + down**2 <= 1
# looking along +z with y down, the near half of the sphere has z < 0; d runs inwards
near = -np.sqrt(np.maximum(1 - right**2 - down**2, 0))
inwards = -np.stack([right, down, near], axis=-1)
values = sh_basis(inwards.reshape(-1, 3), 3).reshape(64, 64, 16)
assert inwards[32, 32, 2] > 0.99

fig, panels = axes(7, 4, height=4.3)
for panel in panels:
    panel.axis("off")
for k in range(16):
    degree = math.isqrt(k)
    order = k - degree * degree - degree
    panel = panels[7 * degree + 3 + order]
    panel.imshow(np.where(on_globe, values[:, :, k], np.nan), cmap=DIVERGING, vmin=-1, vmax=1)
    panel.set_title(f"$Y_{{{k}}}$", loc="center", pad=2, fontsize=8)
picture(fig, "The sixteen harmonics, one row a degree.")

# %% [markdown]
# Here is their sum, with a slider for each coefficient. The ring in the middle is what the camera in front of you sees.
#
# {{widget: harmonics}}
#
# ## Why these polynomials
#
# They are *orthonormal*: over the whole sphere, $\int Y_j Y_k \, d\omega$ is 1 for $j = k$ and 0 otherwise (Ramamoorthi
# and Hanrahan 2001 print the first nine). So each coefficient can be read off by an integral, none disturbs another,
# and cutting the series short gives the best approximation that the remaining terms allow, in the mean square.
#
# A quadrature checks it: Gauss–Legendre nodes along the axis, equal steps around it. For polynomials of this degree it
# is exact.

# %%
z, z_weights = np.polynomial.legendre.leggauss(24)
around = 2 * np.pi * np.arange(48) / 48
zs, phis = (each.ravel() for each in np.meshgrid(z, around, indexing="ij"))
sphere = np.stack(
    [np.sqrt(1 - zs**2) * np.cos(phis), np.sqrt(1 - zs**2) * np.sin(phis), zs], axis=1
)
weights = np.repeat(z_weights, 48) * 2 * np.pi / 48

Y = sh_basis(sphere, 3)
print("integrals of Y_1 Y_j, j = 0..5:", (Y[:, 1] * weights @ Y[:, :6]).round(12) + 0.0)
assert np.isclose(weights.sum(), 4 * np.pi)
assert np.allclose(Y.T @ (weights[:, None] * Y), np.eye(16), atol=1e-12)

# %% [markdown]
# The first harmonic is $Y_0 = 1/\sqrt{4\pi} \approx 0.2821$ everywhere, so $h_0$ alone sets the mean colour: $c = 1/2 +
# Y_0 h_0$. Only the direction of $d$ counts, not its length. And a negative sum is cut to 0, while nothing is cut at 1:
# a picture is clipped only when it is shown.
#
# What do the numbers of a colour measure? Not light. A photograph's file stores about $L^{1/2.2}$, near the root of the
# light $L$, because eyes tell dark tones apart more finely; the exponent is called *gamma*. 3DGS, POP and all that
# follow compare and blend these encoded numbers as they are and never decode them. A pixel that is an even mixture of a
# black and a white splat is 0.5, which a screen shows with a fifth of the light of white, not with half of it.

# %%
assert round(1 / math.sqrt(4 * math.pi), 4) == 0.2821
assert 0.2 < 0.5**2.2 < 0.23
assert np.allclose(Y[:, 0], 0.5 / math.sqrt(math.pi))

rng = np.random.default_rng(3)
sh = 0.3 * rng.normal(size=(1, 16, 3))
d = np.array([[0.3, -1.0, 2.0]])
by_hand = 0.5 + sh_basis(d / np.linalg.norm(d), 3)[0] @ sh[0]
print("by hand", by_hand.round(3), " by the oracle", colors_from_sh(sh, d, 3)[0].round(3))
assert np.allclose(colors_from_sh(sh, d, 3)[0], np.maximum(by_hand, 0))
assert np.allclose(colors_from_sh(sh, d, 3), colors_from_sh(sh, 10 * d, 3))
bright = colors_from_sh(np.full((1, 1, 3), 9.0), d, 0)
assert bright.min() > 1

# %% [markdown]
# ## What degree 3 can show
#
# Take a grey surface with a highlight, $0.25 + 0.75 \max(d \cdot m, 0)^{10}$ with $m$ the mirror direction, and read
# its coefficients off by quadrature. The series shows what its degree can follow: at degree 3 the highlight comes out
# wider, little more than half as high, and with ripples around it.

# %%
mirror = np.array([0.0, 0.0, 1.0])


def highlight(dirs: np.ndarray) -> np.ndarray:
    return 0.25 + 0.75 * np.maximum(dirs @ mirror, 0.0) ** 10


h = Y.T @ (weights * (highlight(sphere) - 0.5))
as_sh = np.repeat(h[None, :, None], 3, axis=2)

turn = np.linspace(-np.pi, np.pi, 361)
meridian = np.stack([np.sin(turn), np.zeros(361), np.cos(turn)], axis=1)
series = [colors_from_sh(np.repeat(as_sh, 361, axis=0), meridian, n)[:, 0] for n in range(4)]

errors = []
for n in range(4):
    on_sphere = colors_from_sh(np.repeat(as_sh, len(sphere), axis=0), sphere, n)[:, 0]
    errors.append(math.sqrt(weights @ (on_sphere - highlight(sphere)) ** 2 / (4 * np.pi)))
assert errors == sorted(errors, reverse=True)
assert 0.5 < (series[3].max() - 0.25) / 0.75 < 0.6
assert series[3].min() < 0.2
print("root mean square errors, degrees 0 to 3:", np.round(errors, 3))

fig, ax = axes(height=2.7)
ax.plot(np.degrees(turn), highlight(meridian), color=INK, lw=1.2, label="the surface")
for n, shade in ((0, MUTED), (1, THIRD), (2, SECOND), (3, ACCENT)):
    ax.plot(np.degrees(turn), series[n], color=shade, label=f"degree {n}")
ax.set(xlim=(-180, 180), xticks=range(-180, 181, 60), ylim=(0, 1.05))
ax.set(xlabel="angle from the mirror direction, degrees", ylabel="colour")
ax.legend(loc="upper left", ncols=2)
picture(
    fig,
    "A highlight and its harmonics. Sharp reflections are out of reach; broad sheen is not.",
)

# %% [markdown]
# ## The same Gaussian from eight sides
#
# In a render, $d$ runs from the camera's centre to the Gaussian's: one direction serves all pixels of a splat. Give a
# Gaussian a red side and a blue side, in degrees 0 and 1 only, and walk around it.

# %%
coefficients = np.zeros((1, 4, 3))
# degree 1 is (-y, z, -x) times a constant
coefficients[0, 2] = [-0.9, 0.0, 0.9]
# little green on any side
coefficients[0, 0, 1] = -1.3
ball = Gaussians(
    np.zeros((1, 3)), np.eye(4)[:1], np.full((1, 3), 0.4), np.ones(1), coefficients
)
K = np.array([[24.0, 0.0, 10.0], [0.0, 24.0, 10.0], [0.0, 0.0, 1.0]])


def seen_from(angle: float) -> np.ndarray:
    """Render the ball from a circle around it; at angle 0 the camera looks along +z."""
    c, s = math.cos(angle), math.sin(angle)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]
    viewmat[2, 3] = 3.0
    return render(ball, Camera(viewmat, K, 20, 20), background=np.ones(3)).image


views = [seen_from(2 * math.pi * k / 8) for k in range(8)]
front, back = views[0][10, 10], views[4][10, 10]
assert front[2] > front[0]
assert back[0] > back[2]
assert np.allclose(views[2][10, 10, 0], views[2][10, 10, 2])

fig, panels = axes(8, height=1.25)
for k, (panel, view) in enumerate(zip(panels, views, strict=True)):
    show_image(panel, view, f"{45 * k}°")
    panel.axis("off")
picture(fig, "One Gaussian with four coefficients a channel, seen from eight sides.")

# %% [markdown]
# ## Where the numbers go
#
# Degree 3 has 16 coefficients of three channels: 48 of the 59 numbers that a Gaussian stores. Training does not start
# with all of them: it begins with degree 0 and adds a degree every 1000 steps, so that a colour settles before its
# variation is fitted.

# %%
mean, quaternion, scale, opacity = 3, 4, 3, 1
assert mean + quaternion + scale + opacity + 16 * 3 == 59
for step, degree in ((0, 0), (999, 0), (1000, 1), (2000, 2), (3000, 3), (30_000, 3)):
    assert sh_degree_at(step) == degree

# %% [markdown]
# ### Exercise 1: derive
# Which $h_0$ makes a Gaussian of degree 0 look orange, $(1, 0.6, 0.1)$, from everywhere?

# %% answer
# Solve $c = 1/2 + Y_0 h_0$: $h_0 = (c - 1/2) / Y_0$. This is how a point cloud's colours become a first scene.
orange = np.array([1.0, 0.6, 0.1])
h_0 = (orange - 0.5) * math.sqrt(4 * math.pi)
seen = colors_from_sh(np.repeat(h_0[None, None], len(sphere), axis=0), sphere, 0)
assert np.allclose(seen, orange)

# %% [markdown]
# ### Exercise 2: derive
# With degree 1 only, in which direction $d$ is a channel brightest, given its $h_1, h_2, h_3$? And how much brighter
# than its mean is it there?

# %% answer
# The sum is $C\,(-h_1 y + h_2 z - h_3 x)$ with $C = \sqrt{3 / 4\pi}$, the product of $d$ with the vector
# $C\,(-h_3, -h_1, h_2)$. It is largest along that vector, by the vector's length.
h_1, h_2, h_3 = 0.3, -0.5, 0.2
vector = math.sqrt(3 / (4 * math.pi)) * np.array([-h_3, -h_1, h_2])
channel = np.zeros((1, 4, 3))
channel[0, 1:, 0] = h_1, h_2, h_3
brightest = colors_from_sh(channel, vector[None], 1)[0, 0]
everywhere = colors_from_sh(np.repeat(channel, len(sphere), axis=0), sphere, 1)[:, 0]
assert np.isclose(brightest, 0.5 + np.linalg.norm(vector))
assert brightest >= everywhere.max()

# %% [markdown]
# ### Exercise 3: predict
# A camera looks at a Gaussian and then from the exact opposite side. Which coefficients make the two colours differ?

# %% answer
# Those of odd degree: $Y_k(-d) = -Y_k(d)$ for degrees 1 and 3, $Y_k(-d) = Y_k(d)$ for degrees 0 and 2.
sign = np.array([1] + [-1] * 3 + [1] * 5 + [-1] * 7)
assert np.allclose(sh_basis(-sphere, 3), sign * Y)

# %% [markdown]
# ### Exercise 4: code
# Eight photographs see a Gaussian from eight sides and give its red there: fit the four coefficients of degrees 0 and 1
# by least squares. Try it on the ball of this chapter, and remember the offset.

# %% answer
# $Y h = c - \frac12$, one row a photograph, four unknowns: `lstsq` does it. Where a colour was cut off at 0, the fit
# would be wrong; here none is.
k = np.arange(8)
around = np.stack([np.sin(2 * np.pi * k / 8), 0.2 * (k % 3), np.cos(2 * np.pi * k / 8)], axis=1)
around /= np.linalg.norm(around, axis=1, keepdims=True)
reds = colors_from_sh(np.repeat(coefficients, 8, axis=0), around, 1)[:, 0]
fitted, *_ = np.linalg.lstsq(sh_basis(around, 1), reds - 0.5, rcond=None)
print("fitted", fitted.round(6) + 0.0, " true", coefficients[0, :, 0])
assert reds.min() > 0.0
assert np.allclose(fitted, coefficients[0, :, 0])

# %% [markdown]
# ### Exercise 5: find the bug
# One sign of the sixteen polynomials is wrong. Which?
#
# {{bug: sh_sign}}

# %% answer
# The first of degree 1 must be $-y$. A scene that is trained and drawn by this program looks right, since it learns
# coefficients of the other sign; exchanged with any other program it is lit from the wrong side.
print(caught("sh_sign"))
