# minutes: 45

# %% [markdown]
# # 5b. The backward pass of geometry and colour, line by line
#
# Chapter 5 carried the gradient from the picture to each splat: to its centre, its conic, its opacity and its colour.
# At the end of this chapter you can carry it on, to the position, widths, rotation and colour coefficients of the
# Gaussian in space, and every line of the oracle's `_vjp` functions is one that you could have written.
#
# ## Three rules are enough
#
# Write $\langle A, B \rangle = \sum_{ij} A_{ij} B_{ij}$ for the product of two matrices of one shape. A cotangent $v_Y$
# is the matrix with $dL = \langle v_Y, dY \rangle$ for every small change $dY$. To find $v_X$, write $dY$ by $dX$, put
# it in, and move everything else to the other side, with $\langle A, B C \rangle = \langle B^\top A, C \rangle =
# \langle A C^\top, B \rangle$:
#
# | forwards | small change | backwards |
# |---|---|---|
# | $Y = A X B$ | $dY = A\, dX\, B$ | $v_X = A^\top v_Y B^\top$ |
# | $Y = X X^\top$ | $dY = dX\, X^\top + X\, dX^\top$ | $v_X = (v_Y + v_Y^\top) X$ |
# | $Y = X^{-1}$ | $dY = -Y\, dX\, Y$ | $v_X = -Y^\top v_Y Y^\top$ |
#
# The last follows from $X Y = I$, so $dX\, Y + X\, dY = 0$. With these the whole geometry can be walked back.
#
# The way forwards, from chapter 2 (3DGS, eq. 6 and eq. 5), and the way back, below:
#
# $$q, s \;\to\; M = R\,\mathrm{diag}(s) \;\to\; \Sigma = M M^\top \;\to\;
# \Sigma_{\mathrm{cam}} = R_c\, \Sigma R_c^\top$$
#
# $$\Sigma_{\mathrm{cam}} \;\to\; \Sigma^{2D} = J \Sigma_{\mathrm{cam}} J^\top \;\to\;
# Q = (\Sigma^{2D} + 0.3\, I)^{-1}$$

# %% setup
import math

import numpy as np

from pop_ref.camera import (
    camera_center_vjp,
    covars_cam_from_covars,
    covars_cam_from_covars_vjp,
    means_cam_from_means,
    means_cam_from_means_vjp,
    view_dirs,
    view_dirs_vjp,
)
from pop_ref.compositing import composite_vjp
from pop_ref.constants import PAPER
from pop_ref.covariance import (
    covars_from_quats_scales,
    covars_from_quats_scales_vjp,
    rotmats_from_quats,
    rotmats_from_quats_vjp,
)
from pop_ref.footprint import (
    compensations,
    compensations_vjp,
    conics_from_covars2d,
    conics_from_covars2d_vjp,
    low_pass,
)
from pop_ref.harmonics import colors_from_sh, colors_from_sh_vjp, sh_basis
from pop_ref.projection import (
    project_covars,
    project_covars_vjp,
    project_means_vjp,
    projection_jacobians,
    projection_jacobians_vjp,
)
from pop_ref.records import Camera, Gaussians
from pop_ref.render import render, render_vjp
from pop_ref.walkthrough.bugs import caught
from pop_ref.walkthrough.pages import picture
from pop_ref.walkthrough.style import ACCENT, SECOND, THIRD, axes, show_image

rng = np.random.default_rng(5)
SIZE = 24
turn = rotmats_from_quats(np.array([[0.98, 0.05, -0.15, 0.1]]))[0]
viewmat = np.eye(4)
viewmat[:3, :3], viewmat[:3, 3] = turn, [0.1, 0.05, 0.2]
K = np.array([[26.0, 0, SIZE / 2], [0, 26.0, SIZE / 2], [0, 0, 1.0]])
camera = Camera(viewmat, K, SIZE, SIZE)
n = 6
scene = Gaussians(
    means=np.column_stack([rng.uniform(-0.7, 0.7, (n, 2)), rng.uniform(2.5, 4.0, n)]),
    quats=rng.normal(size=(n, 4)),
    scales=rng.uniform(0.1, 0.5, (n, 3)),
    opacities=rng.uniform(0.3, 0.9, n),
    sh=rng.normal(size=(n, 4, 3)) * np.array([1.0, 0.4, 0.4, 0.4])[:, None],
)
view = render(scene, camera, np.ones(3))
photograph = np.full((SIZE, SIZE, 3), 0.5)
v_image = 2.0 * (view.image - photograph) / view.image.size

# %% [markdown]
# The scene of this chapter is six Gaussians before a camera that is turned a little; the loss compares the picture with
# plain grey. Forwards once, by the functions of chapter 2, keeping everything on the way:

# %%
R, s = rotmats_from_quats(scene.quats), scene.scales
covars = covars_from_quats_scales(scene.quats, s)
means_cam = means_cam_from_means(scene.means, viewmat)
covars_cam = covars_cam_from_covars(covars, viewmat)
J = projection_jacobians(means_cam, K, SIZE, SIZE)
covars2d = project_covars(covars_cam, J)
conics = conics_from_covars2d(low_pass(covars2d, PAPER.eps2d))

# chapter 5: from the picture to the splats
v_splats = composite_vjp(
    view.splats, view.tile_lists, SIZE, SIZE, 16, v_image, background=np.ones(3)
)
v_means2d, v_conics, v_colors = v_splats.v_means2d, v_splats.v_conics, v_splats.v_colors
assert np.allclose(conics, view.splats.conics)
print("arriving at Gaussian 0: v_means2d", v_means2d[0].round(5))
print("                        v_conics ", v_conics[0].round(5))


def slope(function, x: np.ndarray, v: np.ndarray, h: float = 1e-6) -> np.ndarray:
    """Differentiate <v, function(x)> with respect to each entry of x, by differences."""
    found = np.zeros_like(x)
    for at in np.ndindex(x.shape):
        step = np.zeros_like(x)
        step[at] = h
        found[at] = np.sum(v * (function(x + step) - function(x - step))) / (2.0 * h)
    return found


# %% [markdown]
# ## From the conic to the covariance
#
# The third rule, and one trap. The conic keeps three numbers $(A, B, C)$ of a symmetric matrix whose off-diagonal $B$
# stands *twice*. So when a $2 \times 2$ cotangent is built from three numbers, each of its two off-diagonal entries
# gets *half* of $v_B$: their sum is what a change of $B$ costs.
#
# {{source: pop_ref.footprint.conics_from_covars2d_vjp}}
#
# The blur adds a constant, so its vjp returns what it was given.

# %%
i = 0
A, B, C = conics[i]
Q = np.array([[A, B], [B, C]])
v_A, v_B, v_C = v_conics[i]
V = np.array([[v_A, v_B / 2.0], [v_B / 2.0, v_C]])
v_covar2d = -Q @ V @ Q
v_covars2d = conics_from_covars2d_vjp(low_pass(covars2d, PAPER.eps2d), v_conics)
print("by hand ", v_covar2d.ravel().round(7))
print("oracle  ", v_covars2d[i].ravel().round(7))
assert np.allclose(v_covar2d, v_covars2d[i], rtol=1e-9)

# %% [markdown]
# ## From the screen to the camera
#
# $\Sigma^{2D} = J \Sigma_{\mathrm{cam}} J^\top$ depends on two things. With respect to $\Sigma_{\mathrm{cam}}$ it is
# the first rule. With respect to $J$ it is like the second: $J$ stands on both sides, and with $V = v_{\Sigma^{2D}}$
# and symmetric matrices $v_J = 2 V J \Sigma_{\mathrm{cam}}$.
#
# {{source: pop_ref.projection.project_covars_vjp}}
#
# And here is the part that is most often forgotten: **$J$ depends on where the Gaussian is.** Its entries are $f_x/z$,
# $f_y/z$, $-f_x x/z^2$ and $-f_y y/z^2$. A Gaussian that moves away shrinks on the screen, and the loss may want just
# that. So a position has *two* gradients from geometry, one through the centre on the screen,
#
# $$v_x = \frac{f_x}{z} v_u, \qquad v_y = \frac{f_y}{z} v_v, \qquad
# v_z = -\frac{f_x x\, v_u + f_y y\, v_v}{z^2},$$
#
# and one through $J$:
#
# {{source: pop_ref.projection.projection_jacobians_vjp}}
#
# {{source: pop_ref.projection._offset_vjp}}
#
# The helper handles one entry $-f_x t / z^2$, where $t = z\,\mathrm{clamp}(x / z)$ (kink B1). At exactly the limit the
# derivative from inside is taken. Where it is clamped, $t /
# z$ is a constant: moving sideways changes nothing, and only one factor $1/z$ is left to differentiate.

# %%
v_covars_cam, v_J = project_covars_vjp(covars_cam, J, v_covars2d)
assert np.allclose(v_covars_cam[i], J[i].T @ v_covar2d @ J[i])
assert np.allclose(v_J[i], 2.0 * v_covar2d @ J[i] @ covars_cam[i])

through_center = project_means_vjp(means_cam, K, SIZE, SIZE, v_means2d)
through_J = projection_jacobians_vjp(means_cam, K, SIZE, SIZE, v_J)
print("gradient of the camera-space position, through the centre", through_center[i].round(5))
print("                                       through J         ", through_J[i].round(5))

x, y, z = means_cam[i]
f = K[0, 0]
(v_xx, _, v_xz), (_, v_yy, v_yz) = v_J[i]
by_hand = [
    -f / z**2 * v_xz,
    -f / z**2 * v_yz,
    2 * f / z**3 * (x * v_xz + y * v_yz) - f / z**2 * (v_xx + v_yy),
]
assert np.allclose(through_J[i], by_hand)
assert np.allclose(
    through_J,
    slope(lambda p: projection_jacobians(p, K, SIZE, SIZE), means_cam, v_J),
    rtol=1e-5,
    atol=1e-9,
)

# %% [markdown]
# ## From the camera to the world
#
# Both steps are linear. A point is turned and moved, $p = R_c\, \mu + t$, so its cotangent is turned back, $v_\mu =
# R_c^\top v_p$. A covariance is turned on both sides, so by the first rule
# $v_\Sigma = R_c^\top v_{\Sigma_{\mathrm{cam}}} R_c$.
#
# A camera can be learnt, too, and every one of these maps has a cotangent of its own. Summed over Gaussians, $p$ gives
# $v_{R_c} = \sum v_p\, \mu^\top$ and $v_t = \sum v_p$. The covariance, in which $R_c$ stands twice, gives by the
# second rule $v_{R_c} = \sum (V R_c \Sigma^\top + V^\top R_c \Sigma)$ with $V = v_{\Sigma_{\mathrm{cam}}}$. The
# camera's centre is $e = -R_c^\top t$, so $v_{R_c} = -t\, v_e^\top$ and $v_t = -R_c\, v_e$; and since the direction of
# view is $d = \mu - e$, $v_e = -\sum v_d$.

# %%
R_cam = viewmat[:3, :3]
v_covars = np.array([R_cam.T @ v @ R_cam for v in v_covars_cam])
v_means = (through_center + through_J) @ R_cam
# what the camera gets, by each of the four maps
v_p, V_cam = through_center + through_J, v_covars_cam
_, v_view = means_cam_from_means_vjp(scene.means, viewmat, v_p)
assert np.allclose(v_view[:3], np.column_stack([v_p.T @ scene.means, v_p.sum(axis=0)]))
_, v_view = covars_cam_from_covars_vjp(covars, viewmat, V_cam)
turned = V_cam @ R_cam @ np.swapaxes(covars, 1, 2) + np.swapaxes(V_cam, 1, 2) @ R_cam @ covars
assert np.allclose(v_view[:3, :3], turned.sum(axis=0))
v_e = np.array([1.0, -2.0, 0.5])
v_view = camera_center_vjp(viewmat, v_e)
assert np.allclose(v_view[:3], np.column_stack([-np.outer(viewmat[:3, 3], v_e), -R_cam @ v_e]))
_, v_view = view_dirs_vjp(scene.means, viewmat, v_p)
assert np.allclose(v_view, camera_center_vjp(viewmat, -v_p.sum(axis=0)))

# %% [markdown]
# ## From the covariance to widths and rotation
#
# $\Sigma = M M^\top$ is the second rule. $M = R\,\mathrm{diag}(s)$ has the entries $M_{ij} = R_{ij} s_j$, so
# $v_{R_{ij}} = v_{M_{ij}} s_j$ and $v_{s_j} = \sum_i R_{ij} v_{M_{ij}}$:
#
# {{source: pop_ref.covariance.covars_from_quats_scales_vjp}}
#
# The entries of $R$ are quadratic in the unit quaternion $u$; for example $R_{10} = 2 (xy + wz)$ and $R_{01} = 2 (xy -
# wz)$ give $v_w$ the terms $2 z\, v_{R_{10}} - 2 z\, v_{R_{01}}$. Collecting all nine entries for each of the four
# numbers gives four lines. The last step is the division by the length, of chapter 1b.
#
# {{source: pop_ref.covariance.rotmats_from_quats_vjp}}

# %%
v_M = (v_covars[i] + v_covars[i].T) @ (R[i] * s[i])
v_s, v_R = np.sum(R[i] * v_M, axis=0), v_M * s[i]
v_q = rotmats_from_quats_vjp(scene.quats[i : i + 1], v_R[None])[0]
v_quats, v_scales = covars_from_quats_scales_vjp(scene.quats, s, v_covars)
print("v_scales", v_scales[i].round(5), " v_quats", v_quats[i].round(5))
assert np.allclose(v_s, v_scales[i])
assert np.allclose(v_q, v_quats[i])
assert np.allclose(
    v_quats,
    slope(lambda q: covars_from_quats_scales(q, s), scene.quats, v_covars),
    rtol=1e-5,
    atol=1e-9,
)
assert np.allclose(
    v_scales,
    slope(lambda x: covars_from_quats_scales(scene.quats, x), s, v_covars),
    rtol=1e-5,
    atol=1e-9,
)

# %% [markdown]
# ## Colour: coefficients and direction
#
# $c = \max(\frac12 + \sum_k Y_k(d / \lvert d \rvert)\, h_k, 0)$ (chapter 3). Where the sum is under 0, nothing passes;
# at exactly 0 the derivative from above is taken (kink B2). Else the sum is linear in the coefficients,
# $v_{h_k} = Y_k\, v_c$; and it depends on the direction,
# $v_{Y_k} = h_k \cdot v_c$, so $v_u = \sum_k v_{Y_k} \nabla Y_k$, and $v_d$ follows by the division by the length, as
# for the quaternion.
#
# {{source: pop_ref.harmonics.colors_from_sh_vjp}}
#
# The direction runs from the camera at $e$ to the Gaussian, $d = \mu - e$, so $v_\mu$ gets a **third** part, $v_d$.
# Some programs leave it out: moving a Gaussian also changes the side from which it is seen.

# %%
dirs = view_dirs(scene.means, viewmat)
v_sh, v_dirs = colors_from_sh_vjp(scene.sh, dirs, 1, v_colors)
d, length = dirs[i], math.hypot(*dirs[i])
Y = sh_basis(dirs[i : i + 1] / length, 1)[0]
lit = np.where(0.5 + Y @ scene.sh[i] >= 0.0, v_colors[i], 0.0)
assert np.allclose(v_sh[i], np.outer(Y, lit))
assert np.allclose(
    v_dirs,
    slope(lambda x: colors_from_sh(scene.sh, x, 1), dirs, v_colors),
    rtol=1e-4,
    atol=1e-8,
)
print("the same position, through the colour:", v_dirs[i].round(5))

# %% [markdown]
# ## All of it
#
# The three parts of a position's gradient, added, and the rest, against the oracle's own `render_vjp`, which does the
# same for a whole scene:

# %%
total = v_means + v_dirs
whole = render_vjp(scene, camera, v_image, background=np.ones(3))
for name, mine in (("means", total), ("quats", v_quats), ("scales", v_scales), ("sh", v_sh)):
    theirs = getattr(whole, name)
    print(
        f"{name:7} largest {np.abs(theirs).max():.4f}, off by {np.abs(mine - theirs).max():.0e}"
    )
    assert np.allclose(mine, theirs, rtol=1e-9, atol=1e-13)

fig, (left, right) = axes(2, height=2.7, width_ratios=[1, 1.6])
show_image(left, view.image, "the scene")
left.set(xticks=[], yticks=[])
places = np.arange(n)
shares = {
    "the centre": through_center @ R_cam,
    "the Jacobian": through_J @ R_cam,
    "the colour": v_dirs,
}
for k, ((name, part), shade) in enumerate(
    zip(shares.items(), (ACCENT, SECOND, THIRD), strict=True)
):
    right.bar(
        places + 0.27 * (k - 1), np.linalg.norm(part, axis=1), 0.25, color=shade, label=name
    )
right.set(xlabel="Gaussian", xticks=places, ylabel="norm, loss per world unit")
right.set(title="a position's gradient, by the way it came")
right.legend()
picture(
    fig,
    "Sizes of the three parts. The centre usually has the most, but a program that drops the others trains on a wrong "
    "gradient, and no picture shows it.",
)
assert np.linalg.norm(through_J) > 0.03 * np.linalg.norm(through_center)
sizes = np.array([np.linalg.norm(part, axis=1) for part in shares.values()])
assert np.mean(np.argmax(sizes, axis=0) == 0) > 0.5

# %% [markdown]
# ### Exercise 1: predict
# The Gaussian lies exactly on the optical axis, $x = y = 0$, and its splat is too large. Through which of the three
# ways does its *depth* get a gradient?

# %% answer
# Through the Jacobian alone: $v_z$ through the centre has $x$ and $y$ as factors and vanishes, and a move along the
# direction of view does not change the direction. The diagonal of $J$, $f/z$, shrinks as the Gaussian moves away.
axis = np.array([[0.0, 0.0, 3.0]])
one = project_means_vjp(axis, K, SIZE, SIZE, np.array([[1.0, -2.0]]))[0]
two = projection_jacobians_vjp(axis, K, SIZE, SIZE, np.array([[[1.0, 0, 0.3], [0, 1.0, 0.3]]]))[
    0
]
print("through the centre", one, " through J", two.round(2))
assert one[2] == 0.0
assert two[2] < 0.0

# %% [markdown]
# ### Exercise 2: derive
# In the antialiased mode an opacity is multiplied by $\rho = \sqrt{\det \Sigma / \det(\Sigma + \epsilon I)}$. Derive
# $v_\Sigma$ from $v_\rho$, with $d \ln\det X = \langle X^{-\top}, dX \rangle$.

# %% answer
# $\ln \rho = \frac12 (\ln\det \Sigma - \ln\det(\Sigma + \epsilon I))$, so $d\rho = \frac{\rho}{2} \langle \Sigma^{-1} -
# (\Sigma + \epsilon I)^{-1}, d\Sigma \rangle$ and $v_\Sigma = v_\rho \frac{\rho}{2} (\Sigma^{-1} - (\Sigma + \epsilon
# I)^{-1})$.
rho = compensations(covars2d, 0.3)
inverse, of_blurred = (np.linalg.inv(covars2d + eps * np.eye(2)) for eps in (0.0, 0.3))
mine = 0.5 * rho[:, None, None] * (inverse - of_blurred)
assert np.allclose(mine, compensations_vjp(covars2d, 0.3, np.ones(n)))

# %% [markdown]
# ### Exercise 3: code
# The camera has a gradient, too: that is how poses are refined. For $p = R_c\, \mu + t$, what are $v_{R_c}$ and
# $v_t$, given $v_p$ of every Gaussian? (Take the part through the centres only.) Check against a difference.

# %% answer
# $dL = \sum_i v_{p_i} \cdot (dR_c\, \mu_i + dt)$, so $v_{R_c} = \sum_i v_{p_i} \mu_i^\top$ and $v_t = \sum_i v_{p_i}$.
v_R_cam = through_center.T @ scene.means
v_t = through_center.sum(axis=0)


def moved(matrix: np.ndarray) -> np.ndarray:
    p = scene.means @ matrix[:3, :3].T + matrix[:3, 3]
    return (p @ K.T)[:, :2] / p[:, 2:]


by_difference = slope(moved, viewmat, v_means2d)
print(v_t.round(6), by_difference[:3, 3].round(6))
assert np.allclose(v_R_cam, by_difference[:3, :3], rtol=1e-5, atol=1e-9)
assert np.allclose(v_t, by_difference[:3, 3], rtol=1e-5, atol=1e-9)

# %% [markdown]
# ### Exercise 4: find the bug
# The trap of this chapter, as more than one program had it.
#
# {{bug: conic_off_diagonal_twice}}

# %% answer
# The off-diagonal cotangent is not halved. A splat along the axes gets twice the gradient that would turn or shear it,
# and the right one for its widths; for a turned splat all of it is wrong. It points downhill often enough for a
# training to go on.
V_twice = np.array([[v_A, v_B], [v_B, v_C]])
along_axes = np.diag([2.0, 0.5])
right, wrong = (-along_axes @ each @ along_axes for each in (V, V_twice))
assert np.array_equal(np.diag(right), np.diag(wrong))
assert np.isclose(wrong[0, 1], 2.0 * right[0, 1])
assert not np.allclose(np.diag(-Q @ V_twice @ Q), np.diag(v_covar2d), rtol=1e-2)
print(caught("conic_off_diagonal_twice"))
