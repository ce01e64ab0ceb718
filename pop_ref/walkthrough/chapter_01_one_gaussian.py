# minutes: 25

# %% [markdown]
# # 1. One Gaussian, one pixel
#
# A splat is a soft, elliptical dab of paint on the screen. At the end of this chapter you can compute by hand what one
# splat does to one pixel: its distance in standard deviations, its falloff, its alpha, and the colour that results.
#
# ## What a splat is
#
# Everything here happens on the screen, where lengths are pixels, $x$ runs right and $y$ runs down. A splat has
#
# - a centre $\mu$, two numbers, px;
# - a *covariance* $\Sigma$, a symmetric 2 × 2 matrix, px²: its eigenvectors are the axes of the ellipse, the roots of
#   its eigenvalues the standard deviations along them;
# - an *opacity* $o$ between 0 and 1: how much it hides at its centre;
# - a colour $c$, three numbers.
#
# How a Gaussian in space becomes a splat is chapter 2. Here is one to look at; the widget below lets you drag one
# about.

# %%
import math

import numpy as np

from pop_ref.alpha import alpha_from_sigma, falloff, sigma_at_pixel
from pop_ref.constants import PAPER
from pop_ref.footprint import conics_from_covars2d, radii_from_covars2d
from pop_ref.pixel import SplatRows, composite_pixel
from pop_ref.walkthrough.bugs import caught
from pop_ref.walkthrough.pages import picture
from pop_ref.walkthrough.style import ACCENT, INK, MUTED, SECOND, THIRD, axes, show_image

WIDTH, HEIGHT = 24, 16
mean2d = np.array([12.1, 7.4])
covar2d = np.array([[10.0, 3.0], [3.0, 4.0]])
opacity = 0.8
color = np.array([0.15, 0.45, 0.85])
background = np.array([1.0, 0.95, 0.85])

lambdas, directions = np.linalg.eigh(covar2d)
print("standard deviations, px:", np.sqrt(lambdas).round(2))

# %% [markdown]
# ## How far away is a pixel?
#
# A pixel is not a little square here but a point, its centre: pixel $(i, j)$ lies at $p = (i + 0.5, j + 0.5)$, and what
# is between the centres is never looked at. The distance that counts is measured in standard deviations of the splat,
# squared and halved:
#
# $$\sigma(p) = \tfrac{1}{2} (p - \mu)^\top \Sigma^{-1} (p - \mu)$$
#
# This is the exponent in POP paper, eq. 11. $\sigma = 1/2$ on the ellipse of one standard deviation, and $\sigma = k^2
# / 2$ on that of $k$.
#
# The inverse is needed at every pixel, so a renderer makes it once per splat and keeps its three different entries, the
# *conic* $(A, B, C)$. With $d = \mu - p$ the exponent is then $\sigma = (A d_x^2 + C d_y^2)/2 + B d_x d_y$. In the
# oracle:
#
# {{source: pop_ref.alpha.sigma_at_pixel}}

# %%
p = np.array([17.5, 10.5])
d = p - mean2d
by_hand = 0.5 * d @ np.linalg.inv(covar2d) @ d

A, B, C = conic = tuple(conics_from_covars2d(covar2d[None])[0].tolist())
assert np.allclose([[A, B], [B, C]], np.linalg.inv(covar2d))


def sigma_at(x: float, y: float) -> float:
    return sigma_at_pixel(mean2d.tolist(), conic, x, y)


sigma = sigma_at(*p)
assert np.isclose(sigma, by_hand)
long_axis = math.sqrt(lambdas[1]) * directions[:, 1]
for k in (1, 2, 3):
    assert np.isclose(sigma_at(*(mean2d + k * long_axis)), k * k / 2)
print(f"sigma = {sigma:.4f}: the pixel is {math.sqrt(2 * sigma):.2f} standard deviations away")

# %% [markdown]
# ## Falloff and alpha
#
# The splat fades like a Gaussian bell, scaled by its opacity:
#
# $$\alpha(p) = o\, e^{-\sigma(p)}$$
#
# This is POP paper, eq. 11, again. *Alpha* is the share of the light from behind that the splat blocks at this pixel.
# It is not a probability density: the bell is 1 at its top whatever its width, so a wider splat covers more and is no
# fainter.
#
# Rasterizers add two rules that the paper does not print. An alpha under 1/255 changes an 8-bit image by less than one
# level and is skipped (the *floor*, decision D5). And alpha is cut at 0.999 (the *ceiling*, D6), so that no splat
# blocks everything: what lies behind still contributes a little, and has a gradient. In five lines, where `falloff` is
# $e^{-\sigma}$, this is:
#
# {{source: pop_ref.alpha.alpha_from_sigma}}

# %%
alpha, skipped = alpha_from_sigma(sigma, opacity)
print(f"falloff {falloff(sigma):.4f}, alpha {alpha:.4f}")
assert alpha == opacity * falloff(sigma)
assert not skipped

assert PAPER.alpha_floor == 1 / 255
assert PAPER.alpha_ceiling == 0.999
assert alpha_from_sigma(0.0, 1.0) == (0.999, False)
assert alpha_from_sigma(0.0, 1 / 256) == (1 / 256, True)

centres = [[(i + 0.5, j + 0.5) for i in range(WIDTH)] for j in range(HEIGHT)]
sigmas = np.array([[sigma_at(x, y) for x, y in row] for row in centres])
alphas = np.zeros((HEIGHT, WIDTH))
for j, i in np.ndindex(HEIGHT, WIDTH):
    at_pixel, skip = alpha_from_sigma(float(sigmas[j, i]), opacity)
    alphas[j, i] = 0.0 if skip else at_pixel

# %% [markdown]
# The floor gives the splat an edge. Alpha is at least 1/255 where $\sigma \le \ln(255\, o)$, that is inside the ellipse
# of $k = \sqrt{2 \ln(255\, o)}$ standard deviations. Even a fully opaque splat ends at $k = 3.33$, which is the
# most that $k$ may be. The rectangle around that ellipse tells a renderer which pixels to visit at all. It reaches
# $\lceil k \sqrt{a} \rceil$ px from the centre along x and $\lceil k \sqrt{c} \rceil$ along y, where $a$ and $c$ are
# the covariance's entries on the diagonal: the ellipse of any covariance is as wide as these two alone say.

# %%
k = math.sqrt(2 * math.log(255 * opacity))
assert round(math.sqrt(2 * math.log(255)), 2) == 3.33 == PAPER.extent_sigmas
reach = radii_from_covars2d(covar2d[None], np.array([opacity]))[0]
print(
    f"the splat ends at {k:.2f} standard deviations, {reach} px from its centre along x and y"
)
assert reach.tolist() == [math.ceil(k * math.sqrt(10.0)), math.ceil(k * math.sqrt(4.0))]

assert np.array_equal(alphas > 0, sigmas <= k * k / 2)

fig, (left, right) = axes(2, height=2.9, sharey=True)
angle = np.linspace(0, 2 * np.pi, 200)
circle = np.stack([np.cos(angle), np.sin(angle)])
for times, shade in ((1, ACCENT), (2, ACCENT), (k, SECOND)):
    x, y = mean2d[:, None] + times * directions @ (np.sqrt(lambdas)[:, None] * circle)
    left.plot(x, y, color=shade, lw=1.4)
left.plot(*np.array(centres).reshape(-1, 2).T, ".", ms=1.6, color=MUTED)
left.annotate("", p, mean2d, arrowprops={"arrowstyle": "->", "color": INK, "lw": 1.2})
left.annotate("$p$", p, (4, -10), textcoords="offset points")
left.annotate(r"$\mu$", mean2d, (-10, 2), textcoords="offset points")
left.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0), aspect="equal", xlabel="x, px", ylabel="y, px")
left.set(title="Ellipses of 1, 2 and $k$ standard deviations")
left.set(xticks=range(0, WIDTH + 1, 4), yticks=range(0, HEIGHT + 1, 4))
left.grid(False)
seen = np.where(alphas > 0, alphas, np.nan)
drawn = show_image(right, seen, "Alpha, where it is not skipped", vmin=0, vmax=1)
right.set(xticks=range(0, WIDTH + 1, 4), xlabel="x, px")
fig.colorbar(drawn, ax=right, shrink=0.75, label="alpha")
picture(
    fig,
    r"One splat on a screen of 24 × 16 pixels. Left: pixel centres, and the distance $p - \mu$ of one of them. "
    "Right: the alpha of every pixel centre inside the orange ellipse; outside it lies under 1/255.",
)

# %% [markdown]
# ## Opacity also decides how wide a splat is
#
# Since the edge lies at $\sqrt{2 \ln(255\, o)}$ standard deviations, a fainter splat is also a smaller one. At first
# this goes slowly: at an opacity of a tenth more than three quarters of an opaque splat's reach are left.

# %%
reach_of = {o: math.sqrt(2 * math.log(255 * o)) for o in (1.0, 0.5, 0.1, 0.02)}
assert 0.75 < reach_of[0.1] / reach_of[1.0] < 0.8

fig, ax = axes(height=2.7)
distance = np.linspace(0, 4, 400)
for (o, edge), shade in zip(reach_of.items(), (ACCENT, SECOND, THIRD, MUTED), strict=True):
    curve = np.array([alpha_from_sigma(x * x / 2, o)[0] for x in distance])
    ax.plot(
        distance[distance <= edge], curve[distance <= edge], color=shade, label=f"o = {o:g}"
    )
    ax.plot(distance[distance > edge], curve[distance > edge], ":", color=shade, lw=1)
    ax.plot([edge], [1 / 255], "o", color=shade, ms=4)
ax.axhline(1 / 255, color=INK, lw=0.8)
ax.annotate("floor, 1/255", (0.02, 1 / 255), (0, 3), textcoords="offset points")
ax.set(yscale="log", ylim=(5e-4, 1.5), xlim=(0, 4))
ax.set(xlabel="distance, standard deviations", ylabel="alpha")
ax.legend(loc="upper right")
picture(
    fig,
    "Alpha against distance for four opacities. Dots mark where the floor cuts a splat off.",
)

# %% [markdown]
# Here you can move and shape the same splat. What this chapter computed is shown with it.
#
# {{widget: splat2d}}
#
# ## The colour of the pixel
#
# With a single splat, the rendering equation (POP paper, eq. 1) says little more than a painter would: the splat gives
# its colour times $\alpha$, and what is left of the light, $T = 1 - \alpha$, comes from behind.
#
# $$C = \alpha\, c + (1 - \alpha)\, b$$
#
# The paper's sum has no background $b$; every program has one. `composite_pixel` is the oracle's blending loop. It
# takes a list of splats, here a list of one.

# %%
rows = SplatRows([mean2d.tolist()], [conic], [opacity], [color.tolist()])
pixel = composite_pixel([0], rows, p[0], p[1], background.tolist())
print("colour of the pixel", np.round(pixel.color, 3), " light left", round(pixel.T_final, 3))
assert np.allclose(pixel.color, alpha * color + (1 - alpha) * background)
assert np.isclose(pixel.T_final, 1 - alpha)

image = np.zeros((HEIGHT, WIDTH, 3))
for j, i in np.ndindex(HEIGHT, WIDTH):
    image[j, i] = composite_pixel([0], rows, i + 0.5, j + 0.5, background.tolist()).color
assert np.allclose(image, alphas[..., None] * color + (1 - alphas[..., None]) * background)

fig, ax = axes(width=4.2, height=2.7)
show_image(ax, image)
ax.set(xlabel="x, px", ylabel="y, px")
picture(fig, "The same splat blended over a warm background, pixel by pixel.")

# %% [markdown]
# ### Exercise 1: predict
# A splat has opacity 0.5. How many standard deviations from its centre has its alpha fallen to 0.25? Does the answer
# depend on the covariance?

# %% answer
# $0.5\, e^{-k^2/2} = 0.25$ gives $k = \sqrt{2 \ln 2} \approx 1.177$, whatever the covariance.
answer = math.sqrt(2 * math.log(2))
assert round(answer, 3) == 1.177
for axis in range(2):
    end = mean2d + answer * math.sqrt(lambdas[axis]) * directions[:, axis]
    assert np.isclose(alpha_from_sigma(sigma_at(*end), 0.5)[0], 0.25)

# %% [markdown]
# ### Exercise 2: derive
# How much paint is in a splat? Integrate $o\, e^{-\sigma}$ over the plane, and compare with the sum of `alphas` above.
# Why is the sum a little smaller?

# %% answer
# $2 \pi\, o \sqrt{\det \Sigma}$, from the normalising constant of a normal density. The floor takes the share
# $e^{-k^2/2} = 1/(255\, o)$ of it, what lies outside the ellipse of $k$ standard deviations.
paint = opacity * 2 * math.pi * math.sqrt(np.linalg.det(covar2d))
assert np.isclose(alphas.sum(), paint * (1 - 1 / (255 * opacity)), rtol=5e-3)
assert alphas.sum() < paint

# %% [markdown]
# ### Exercise 3: predict
# Shrink the splat to a standard deviation of 0.1 px and put it at (8, 8), on the corner between four pixels. What does
# the image show? (Chapter 2 has the remedy.)

# %% answer
# Nothing at all: the nearest centres are $\sqrt{0.5}$ px away, seven standard deviations.
tiny = conics_from_covars2d(0.01 * np.eye(2)[None])[0].tolist()
nearest = sigma_at_pixel((8.0, 8.0), tiny, 7.5, 7.5)
assert round(math.sqrt(2 * nearest), 1) == 7.1
assert alpha_from_sigma(nearest, 1.0)[1]

# %% [markdown]
# ### Exercise 4: code
# A viewer wants to draw the ellipse where a splat ends, so it needs the lengths of its half axes in px and the angle of
# the longer one. Write the function, and check that alpha on its outline is 1/255.


# %% answer
# The half axes are $k$ times the roots of the eigenvalues, along the eigenvectors.
def outline(covar2d: np.ndarray, opacity: float) -> tuple[float, float, float]:
    lambdas, directions = np.linalg.eigh(covar2d)
    k = math.sqrt(2 * math.log(255 * opacity))
    short, long = k * np.sqrt(lambdas)
    return long, short, math.degrees(math.atan2(directions[1, 1], directions[0, 1]))


long, short, degrees = outline(covar2d, opacity)
print(f"half axes {long:.2f} and {short:.2f} px, turned by {degrees % 180:.1f} degrees")
tip = mean2d + long * np.array(
    [math.cos(math.radians(degrees)), math.sin(math.radians(degrees))]
)
assert np.isclose(alpha_from_sigma(sigma_at(*tip), opacity)[0], 1 / 255)

# %% [markdown]
# ### Exercise 5: find the bug
# What would a picture look like that is drawn with this function? Which number in it is wrong?
#
# {{bug: no_half_in_the_exponent}}

# %% answer
# The half is missing, so $\sigma$ is twice what it should be, and every splat is smaller by $\sqrt 2$. Training makes
# up for it with larger scales, so the pictures look right; only the files are wrong for every other program.
print(caught("no_half_in_the_exponent"))
