# minutes: 30

# %% [markdown]
# # 2. From space to screen
#
# A scene is made of Gaussians in space; chapter 1 painted splats on a screen. At the end of this chapter you know every
# step between them: how a covariance is stored, how the camera turns it, how the pinhole flattens it, and why a little
# blur is added.
#
# ## A covariance that cannot go wrong
#
# A covariance in space is a symmetric 3 × 3 matrix without negative eigenvalues. An optimizer that moves its six
# entries freely would soon leave that set. So the entries are not what is stored. A Gaussian keeps three standard
# deviations $s$ along its own axes and a quaternion $q$ that turns those axes into the world:
#
# $$\Sigma = R S S^\top R^\top, \qquad R = R(q), \quad S = \operatorname{diag}(s)$$
#
# This is 3DGS, eq. 6. Whatever numbers are put in, $\Sigma$ is a covariance. The quaternion is divided by its norm
# first, so its length does not matter, and $q$ and $-q$ are the same rotation. With the unit quaternion $(w, x, y, z) =
# q / \lvert q \rvert$ the matrix is
#
# $$R(q) = \begin{pmatrix} 1 - 2(y^2 + z^2) & 2(xy - wz) & 2(xz + wy) \\
# 2(xy + wz) & 1 - 2(x^2 + z^2) & 2(yz - wx) \\
# 2(xz - wy) & 2(yz + wx) & 1 - 2(x^2 + y^2) \end{pmatrix}$$
#
# (What training moves are the logarithms of $s$, chapter 1b.)
#
# {{source: pop_ref.covariance.covars_from_quats_scales}}

# %%
from dataclasses import replace

import numpy as np

from pop_ref.camera import covars_cam_from_covars, means_cam_from_means
from pop_ref.constants import PAPER
from pop_ref.covariance import covars_from_quats_scales, rotmats_from_quats
from pop_ref.footprint import compensations, conics_from_covars2d, low_pass, radii_from_covars2d
from pop_ref.pixel import SplatRows, composite_pixel
from pop_ref.projection import project_covars, project_means, projection_jacobians
from pop_ref.records import Camera, Gaussians
from pop_ref.splatting import geometry, project
from pop_ref.walkthrough.bugs import broken, caught
from pop_ref.walkthrough.pages import picture
from pop_ref.walkthrough.style import ACCENT, INK, MUTED, SECOND, THIRD, axes

means = np.array([[0.9, 0.5, 1.0], [-0.7, 0.2, -2.3]])
quats = np.array([[0.9, 0.1, 0.4, 0.2], [1.0, -0.1, 0.4, 0.2]])
scales = np.array([[0.25, 0.1, 0.05], [0.15, 0.12, 0.42]])

covars = covars_from_quats_scales(quats, scales)
R = rotmats_from_quats(quats)[0]
unit = quats[0] / np.linalg.norm(quats[0])
w, x, y, z = unit
assert np.allclose(
    R,
    [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ],
)
assert np.allclose(covars[0], R @ np.diag(scales[0] ** 2) @ R.T)
assert np.allclose(np.linalg.eigvalsh(covars[0]), np.sort(scales[0] ** 2))
assert np.array_equal(covars, covars_from_quats_scales(-quats, scales))
assert np.allclose(covars, covars_from_quats_scales(7.0 * quats, scales))

# %% [markdown]
# ## Into the camera
#
# The camera is described by a rigid motion, a rotation $R_c$ and a translation $t$, that takes the world into its own
# frame: $x$ right, $y$ down, $z$ forward. Points move by it, covariances only turn:
#
# $$p = R_c\, \mu + t, \qquad \Sigma_{\mathrm{cam}} = R_c\, \Sigma R_c^\top$$
#
# The second half is the inner part of 3DGS, eq. 5, where the rotation is called $W$. The third coordinate of $p$ is the
# depth. This camera stands four units back and is turned a little.

# %%
turn = rotmats_from_quats(np.array([[1.0, 0.02, -0.06, 0.03]]))[0]
viewmat = np.eye(4)
viewmat[:3, :3] = turn
viewmat[:3, 3] = [0.0, 0.0, 4.0]
f, width, height = 48.0, 64, 48
K = np.array([[f, 0.0, width / 2], [0.0, f, height / 2], [0.0, 0.0, 1.0]])
camera = Camera(viewmat, K, width, height)

means_cam = means_cam_from_means(means, viewmat)
covars_cam = covars_cam_from_covars(covars, viewmat)
assert np.allclose(means_cam[0], turn @ means[0] + viewmat[:3, 3])
assert np.allclose(covars_cam[0], turn @ covars[0] @ turn.T)
depths = means_cam[:, 2]
print("depths:", depths.round(2))

# %% [markdown]
# ## Through the pinhole
#
# A point $(x, y, z)$ in the camera's frame is seen at
#
# $$u = \left( \frac{f_x x}{z} + c_x, \; \frac{f_y y}{z} + c_y \right)$$
#
# with focal lengths $f$ and the principal point $c$ in px. Straight lines stay straight under this map, but equal steps
# along them do not stay equal, since near things look larger: the map is not affine. An affine map takes every Gaussian
# to a Gaussian. What the pinhole makes of one is none: it is lopsided. EWA splatting, which 3DGS builds on, replaces
# the map by its linearisation at the centre, its matrix of first derivatives, the *Jacobian* $J$. Then the covariance
# on the screen is
#
# $$\Sigma^{2D} = J R_c\, \Sigma R_c^\top J^\top, \qquad
# J = \begin{pmatrix} f_x/z & 0 & -f_x x/z^2 \\ 0 & f_y/z & -f_y y/z^2 \end{pmatrix}$$
#
# which is 3DGS, eq. 5, with the Jacobian of EWA, eq. 29. In the oracle, where `tx` is $x$, but for the clamp that comes
# below:
#
# {{source: pop_ref.projection.projection_jacobians}}
#
# Differences confirm $J$:

# %%
J = projection_jacobians(means_cam, K, width, height)
step = 1e-6
for axis in range(3):
    nudge = step * np.eye(3)[axis]
    ahead = project_means(means_cam + nudge, K, width, height)
    behind = project_means(means_cam - nudge, K, width, height)
    column = (ahead - behind) / (2 * step)
    found, wanted = column[0].round(4), J[0, :, axis].round(4)
    print("along", "xyz"[axis], "by a difference", found, " in J", wanted)
    assert np.allclose(column, J[:, :, axis], atol=1e-5)

means2d = project_means(means_cam, K, width, height)
covars2d = project_covars(covars_cam, J)
assert np.allclose(covars2d[0], J[0] @ covars_cam[0] @ J[0].T)

# %% [markdown]
# How good is a linearisation? Draw points from each Gaussian in space, send every one through the true pinhole, and
# compare the cloud with the ellipse. Look along the ellipse's long axis: how far from the centre do the middle 68 % of
# the points reach to either side, in the ellipse's own standard deviations? For a Gaussian it is 1 and 1. (A variance
# would not do: a few points lie so near the plane of the camera that they land anywhere, and the true variance is
# infinite.)


# %%
def sides(k: int, seed: int) -> np.ndarray:
    """Send points of Gaussian k through the pinhole; tell how far the middle 68 % reach."""
    points = np.random.default_rng(seed).multivariate_normal(means_cam[k], covars_cam[k], 6000)
    cloud = project_means(points[points[:, 2] > 0.01], K, width, height)
    lambdas, directions = np.linalg.eigh(covars2d[k])
    along = (cloud - means2d[k]) @ directions[:, 1] / np.sqrt(lambdas[1])
    return np.sort(np.abs(np.quantile(along, [0.16, 0.84])))


for seed in (1, 2, 3):
    small, large = sides(0, seed), sides(1, seed)
    # the small one in the distance is a Gaussian, ...
    assert np.allclose(small, 1.0, atol=0.06)
    # ... the large one near the camera is not: as wide, but much farther to one side
    assert abs(np.mean(large) - 1.0) < 0.08
    assert large[1] / large[0] > 1.3
print("middle 68 % reach, in standard deviations of the ellipse:")
print(f"small and far {sides(0, 1).round(2)}, large and near {sides(1, 1).round(2)}")

# farther out on the same ray, the large one is less and less lopsided
lopsided = []
for away in (1.0, 2.0, 4.0):
    there = away * means_cam[1]
    points = np.random.default_rng(4).multivariate_normal(there, covars_cam[1], 20_000)
    at = project_means(
        np.concatenate([there[None], points[points[:, 2] > 0.01]]), K, width, height
    )
    J_there = projection_jacobians(there[None], K, width, height)
    _, directions = np.linalg.eigh(project_covars(covars_cam[1:], J_there)[0])
    ends = np.sort(np.abs(np.quantile((at[1:] - at[0]) @ directions[:, 1], [0.16, 0.84])))
    lopsided.append(ends[1] / ends[0])
assert lopsided == sorted(lopsided, reverse=True)
assert lopsided[2] < 1.0 + 0.5 * (lopsided[0] - 1.0)

rng = np.random.default_rng(1)
clouds = [
    project_means(rng.multivariate_normal(m, c, 6000), K, width, height)
    for m, c in zip(means_cam, covars_cam, strict=True)
]

# %% [markdown]
# So the ellipse has about the right width in both cases. What it cannot follow is that the near side of a Gaussian
# looks larger than its far side. The error grows with the angle under which a Gaussian is seen, that is with its size
# over its depth.

# %%
fig, (side, screen) = axes(2, height=3.1, width_ratios=[1, 1.15])
angle = np.linspace(0, 2 * np.pi, 120)
circle = np.stack([np.cos(angle), np.sin(angle)])
for i, shade in enumerate((ACCENT, SECOND)):
    # from the side: depth to the right, the camera's x upwards
    xz = np.linalg.cholesky(covars_cam[i][np.ix_([2, 0], [2, 0])])
    side.plot(*(means_cam[i][[2, 0], None] + 2 * xz @ circle), color=shade)
    side.plot(*means_cam[i][[2, 0]], ".", color=shade)
    side.plot([0, 7], [0, 7 * means_cam[i][0] / means_cam[i][2]], ":", color=shade, lw=1)
    ellipse = means2d[i][:, None] + 2 * np.linalg.cholesky(covars2d[i]) @ circle
    screen.plot(*clouds[i][:900].T, ".", ms=1.5, color=shade, alpha=0.35)
    screen.plot(*ellipse, color=INK, lw=1.2)
side.plot([1, 1], [-width / 2 / f, width / 2 / f], color=INK, lw=2)
side.annotate("screen", (1, width / 2 / f), (-8, 4), textcoords="offset points")
side.plot(0, 0, "o", color=INK)
side.annotate("camera", (0, 0), (-8, -15), textcoords="offset points")
side.set(xlim=(-0.3, 6.2), ylim=(-2.4, 2.6), aspect="equal", xlabel="depth z, world units")
side.set(title="From the side", ylabel="x, world units")
screen.set(xlim=(-14, width), ylim=(height, 0), aspect="equal", xlabel="x, px", ylabel="y, px")
screen.set(title="On the screen")
picture(
    fig,
    "Two Gaussians, their ellipses of two standard deviations. Dots on the screen are points of the Gaussians sent "
    "through the true pinhole; the outlines are what the linearisation makes of them: close for the small one "
    "in the distance; the large one near the camera is lopsided, and its ellipse is not.",
)

# %% [markdown]
# Far outside the image the linearisation is worse than poor: $x/z$ grows without bound and with it the ellipse.
# Rasterizers therefore evaluate $J$ no farther out than 15 % of the image's width $W$ (and height) beyond its border:
# in $J$, $x$ is replaced by
#
# $$t_x = z\,\mathrm{clamp}\left(\frac{x}{z}, -\frac{c_x + 0.15\,W}{f_x}, \frac{W - c_x + 0.15\,W}{f_x}\right),$$
#
# and $y$ alike. The profile's `frustum_margin` is 0.3, twice 0.15, because it counts in halves of the image. The papers
# do not print this (kink B1 of the oracle).

# %%
aside = np.array([[20.0, 0.0, 1.0]])
limit = (width / 2 + 0.15 * width) / f
assert PAPER.frustum_margin == 2 * 0.15
assert np.isclose(projection_jacobians(aside, K, width, height)[0, 0, 2], -f * limit)
# and where the principal point is not in the middle
K_off = np.array([[f, 0.0, 20.0], [0.0, f, 30.0], [0.0, 0.0, 1.0]])
for point, over in (
    (aside, (width - 20.0 + 0.15 * width) / f),
    (-aside, -(20.0 + 0.15 * width) / f),
):
    entry = projection_jacobians(
        np.abs(point) * [np.sign(over), 1.0, 1.0], K_off, width, height
    )[0, 0, 2]
    assert np.isclose(entry, -f * over)

# %% [markdown]
# Here you can walk around a Gaussian. Its points go through the true pinhole, its ellipse through $J$.
#
# {{widget: orbit}}
#
# ## A little blur
#
# A pixel looks at one point only. A splat much thinner than a pixel hits a centre or falls between two, and flickers as
# it moves. The remedy of the code bases is to add a small round covariance to every splat:
#
# $$\Sigma^{2D} \leftarrow \Sigma^{2D} + 0.3\, I$$
#
# No equation of the two papers has it; the idea is the low-pass filter of EWA, section 5. Watch a needle of 0.1 px
# slide over the pixels, and add up its alphas.

# %%
needle = np.array([[[0.01, 0.0], [0.0, 9.0]]])
assert PAPER.eps2d == 0.3
blurred = low_pass(needle, PAPER.eps2d)
assert np.allclose(blurred[0], needle[0] + 0.3 * np.eye(2))


def paint(covar2d: np.ndarray, opacity: float, x: float) -> float:
    """Add up the alphas of a splat at (x, 16) on a screen of 24 x 32 px."""
    conic = conics_from_covars2d(covar2d)[0].tolist()
    rows = SplatRows([[x, 16.0]], [conic], [opacity], [[1.0]])
    centres = [(i + 0.5, j + 0.5) for i, j in np.ndindex(24, 32)]
    return sum(composite_pixel([0], rows, *at, [0.0]).color[0] for at in centres)


places = np.arange(10.0, 13.0, 0.05)
sharp = np.array([paint(needle, 0.9, x) for x in places])
soft = np.array([paint(blurred, 0.9, x) for x in places])
assert sharp.min() == 0.0
assert soft.max() / soft.min() < 1.02

# %% [markdown]
# The flicker is gone, at a price: the needle is now more than five times as wide, and no fainter. It covers what it
# should not. Where that matters, as when a view is rendered smaller than it was trained, the *antialiased* mode
# multiplies the opacity by
#
# $$\rho = \sqrt{\det \Sigma^{2D} / \det(\Sigma^{2D} + 0.3\, I)}$$
#
# (the 2D Mip filter of Mip-Splatting), so that the whole amount of paint stays what it was.

# %%
rho = compensations(needle, PAPER.eps2d)[0]
kept = np.array([paint(blurred, 0.9 * rho, x) for x in places])
assert 5 < np.sqrt(blurred[0, 0, 0] / needle[0, 0, 0]) < 6
assert soft.mean() / sharp.mean() > 5
assert abs(kept.mean() / sharp.mean() - 1) < 0.05

fig, ax = axes(height=2.6)
for curve, name, shade in (
    (sharp, "as projected", SECOND),
    (soft, "with the low-pass", ACCENT),
    (kept, "with the low-pass, antialiased", THIRD),
):
    ax.plot(places, curve, color=shade, label=name)
for centre in (10.5, 11.5, 12.5):
    ax.axvline(centre, color=MUTED, lw=0.8, ls=":")
ax.set(xlim=(10, 13), ylim=(0, 11), ylabel="sum of alphas")
ax.set(xlabel="x of the needle, px (dotted: pixel centres)")
ax.legend(loc="upper center", ncols=3, bbox_to_anchor=(0.5, 1.17))
picture(
    fig,
    "A needle slides across three pixels. As projected it is visible only near their centres.",
)

# %% [markdown]
# ## All of it at once
#
# `project` does what this chapter did, for every Gaussian: centre, conic and extent, as chapter 1 used them. It also
# *culls*, that is leaves out, what cannot be seen: a Gaussian whose centre lies behind the camera, nearer to it than
# the *near plane*, at depth 0.01, or beyond the far plane, at $10^{10}$ (decision D1), and one that does not reach the
# image (D2).

# %%
scene = Gaussians(means, quats, scales, np.array([0.9, 0.6]), np.zeros((2, 1, 3)))
splats = project(scene, camera)
ours = low_pass(covars2d, PAPER.eps2d)
assert np.allclose(geometry(scene, camera).blurred, ours)
assert np.allclose(splats.means2d, means2d)
assert np.allclose(splats.conics, conics_from_covars2d(ours))
assert np.array_equal(splats.radii, radii_from_covars2d(ours, scene.opacities))
assert np.allclose(splats.depths, depths)
print("centres, px:", splats.means2d.round(1).tolist(), " extents, px:", splats.radii.tolist())
assert splats.visible.all()


def alone(mean: list[float], standard_deviations: list[float]) -> Gaussians:
    """Make a scene of one Gaussian, opaque and its axes along the world's."""
    return Gaussians(
        np.array([mean]),
        np.array([[1.0, 0.0, 0.0, 0.0]]),
        np.array([standard_deviations]),
        np.ones(1),
        np.zeros((1, 1, 3)),
    )


# %% [markdown]
# ### Exercise 1: derive
# A Gaussian with the same standard deviation $s$ along all axes lies straight ahead at depth $z$. What is its standard
# deviation on the screen before the blur? Why does it not matter how it is turned?

# %% answer
# $x = y = 0$, so $J$ is $f/z$ on the diagonal, and the standard deviation is $f s / z$ all around; $R R^\top = I$
# removes the rotation.
ball = alone([0.0, 0.0, 5.0], [0.2, 0.2, 0.2])
ahead = Camera(np.eye(4), K, width, height)
turned = replace(ball, quats=np.array([[0.3, -0.5, 0.2, 0.8]]))
for each in (ball, turned):
    assert np.allclose(geometry(each, ahead).covars2d[0], (f * 0.2 / 5.0) ** 2 * np.eye(2))

# %% [markdown]
# ### Exercise 2: derive
# The same ball moves sideways to $x = z$. Which axis of its ellipse grows, and by what factor? (Use a screen so wide
# that nothing is clamped.)

# %% answer
# The outward one: $J = \frac{f}{z} \begin{pmatrix} 1 & 0 & -1 \\ 0 & 1 & 0 \end{pmatrix}$, so
# $J J^\top = (f/z)^2 \operatorname{diag}(2, 1)$, and the ball is stretched by $\sqrt 2$.
corner = alone([5.0, 0.0, 5.0], [0.2, 0.2, 0.2])
wide = Camera(np.eye(4), np.array([[f, 0, 400.0], [0, f, 24.0], [0, 0, 1]]), 800, 48)
assert np.allclose(
    geometry(corner, wide).covars2d[0], (f * 0.2 / 5.0) ** 2 * np.diag([2.0, 1.0])
)

# %% [markdown]
# ### Exercise 3: predict
# A disc (one scale zero) is seen exactly edge-on. What is its screen covariance, and what does the blur do for it?

# %% answer
# The disc lies in the plane $y = 0$ through the camera: it is a line on the screen, a covariance of rank one that has
# no inverse and so no conic. The blur gives it one, and the disc is drawn as a line with a standard deviation of 0.55
# px across.
disc = alone([0.0, 0.0, 5.0], [0.2, 0.0, 0.2])
chain = geometry(disc, ahead)
assert np.linalg.det(chain.covars2d[0]) == 0.0
assert np.array_equal(conics_from_covars2d(chain.covars2d)[0], [0.0, 0.0, 0.0])
assert np.linalg.det(chain.blurred[0]) > 0.0
assert round(np.sqrt(chain.blurred[0, 1, 1]), 2) == 0.55
assert project(disc, ahead).visible[0]

# %% [markdown]
# ### Exercise 4: code
# Write the whole chapter in ten lines: from a mean, a quaternion, scales and a camera to the centre and the blurred
# covariance on the screen, without the oracle (leave the clamp out). Compare with `geometry`.


# %% answer
# Rotation of a quaternion, $R S S^\top R^\top$, into the camera, through the pinhole, plus 0.3.
def to_screen(mean, quat, scale, viewmat, K):
    w, x, y, z = quat / np.linalg.norm(quat)
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    M = viewmat[:3, :3] @ R @ np.diag(scale)
    x, y, z = viewmat[:3, :3] @ mean + viewmat[:3, 3]
    J = np.array([[K[0, 0] / z, 0, -K[0, 0] * x / z**2], [0, K[1, 1] / z, -K[1, 1] * y / z**2]])
    centre = np.array([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]])
    return centre, J @ M @ M.T @ J.T + 0.3 * np.eye(2)


for k in range(2):
    centre, covar = to_screen(means[k], quats[k], scales[k], viewmat, K)
    print(centre.round(2), covar.round(2).tolist())
    assert np.allclose(centre, means2d[k])
    assert np.allclose(covar, ours[k])

# %% [markdown]
# ### Exercise 5: find the bug
# The oracle's Jacobian with one mistake. Would you see it in a picture?
#
# {{bug: jacobian_sign}}

# %% answer
# The last column has the wrong sign. This $J \operatorname{diag}(1, 1, -1)$ draws every Gaussian as its mirror image in
# depth. Round ones, and all on the optical axis, look right. The others lean and stretch the wrong way, the more the
# farther out they lie. In a photograph of a real scene it is hard to see.
wrong = broken("jacobian_sign", "projection_jacobians")(means_cam, K, width, height)
mirror = np.diag([1.0, 1.0, -1.0])
assert np.allclose(
    project_covars(covars_cam, wrong), project_covars(mirror @ covars_cam @ mirror, J)
)
print(caught("jacobian_sign"))
