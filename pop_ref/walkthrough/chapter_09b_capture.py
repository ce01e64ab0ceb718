# minutes: 35

# %% [markdown]
# # 9b. From photographs to a first scene: cameras, COLMAP, initial scales
#
# A training begins with photographs whose cameras are known, and with a cloud of points. At the end of this chapter you
# can read a camera in any of the usual conventions, you know what COLMAP finds and how, what its files hold, and how
# each point becomes the first Gaussian.
#
# ## A camera is two matrices
#
# A *capture* is a set of photographs of one scene, with two things known of each: the *intrinsics* $K$, which tell how
# the lens maps directions to pixels, and the *pose*, which tells where the camera stood and how it was turned:
#
# $$K = \begin{pmatrix} f_x & 0 & c_x \\ 0 & f_y & c_y \\ 0 & 0 & 1 \end{pmatrix}, \qquad
# \text{viewmat} = \begin{pmatrix} R_c & t \\ 0 & 1 \end{pmatrix}$$
#
# $$p = R_c\, \mu + t, \quad u = \left( f_x \frac{x}{z} + c_x, \; f_y \frac{y}{z} + c_y \right)$$
#
# (the projection of chapter 2; POP paper, eq. 1, begins after it). The pose takes the world to the camera; the camera
# itself stands at $-R_c^\top t$. The focal length in pixels and the angle of view say the same thing: $f_x =
# \frac{\text{width}}{2} / \tan \frac{\text{angle}}{2}$.
#
# Programs agree on this and disagree on the rest. Every mix-up below gives a picture that is mirrored, upside down,
# empty or slightly shifted:
#
# | | COLMAP, OpenCV, gsplat, this package | OpenGL, Blender, NeRF's `transforms.json` |
# |---|---|---|
# | axes of the camera | x right, y **down**, z **forward** | x right, y **up**, z **backward** |
# | matrix that is stored | world to camera | camera to world, its inverse |
# | quaternions | w first | often w last (SciPy, ROS, glTF) |
# | centre of the first pixel | (0.5, 0.5) | the same, but some programs use (0, 0) |

# %%
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from pop_fast.data import load_capture
from pop_fast.demo import make_demo
from pop_ref.optimizer import learning_rates
from pop_ref.records import Camera, Gaussians
from pop_ref.render import render
from pop_ref.walkthrough.bugs import caught
from pop_ref.walkthrough.pages import picture
from pop_ref.walkthrough.style import ACCENT, INK, MUTED, SECOND, axes, show_image

with tempfile.TemporaryDirectory() as folder:
    make_demo(Path(folder) / "demo", views=12, width=80, height=60)
    files = sorted(str(path.relative_to(folder)) for path in Path(folder).rglob("*.bin"))
    capture = load_capture(Path(folder) / "demo")
view = capture.views[0]
R_cam, t = view.viewmat[:3, :3], view.viewmat[:3, 3]
center = -R_cam.T @ t
angle = 2 * np.degrees(np.arctan(view.width / 2 / view.K[0, 0]))
print(f"fx {view.K[0, 0]:.1f} px, so the view is {angle:.0f} degrees wide")
print(f"the camera stands at {center.round(2)}")
assert np.allclose(center, view.camera_center)
assert np.allclose(R_cam @ R_cam.T, np.eye(3))
assert np.isclose(np.linalg.det(R_cam), 1.0)

# from OpenGL's axes and camera-to-world to the pose here, and back
flip = np.diag([1.0, -1.0, -1.0, 1.0])
for_blender = np.linalg.inv(view.viewmat) @ flip
assert np.allclose(np.linalg.inv(for_blender @ flip), view.viewmat)
print("forwards in the world:          ", R_cam[2].round(2))
print("minus OpenGL's third column:    ", -for_blender[:3, 2].round(2))

# %% [markdown]
# ## What COLMAP does
#
# Poses are not written down while photographs are taken. *Structure from motion* finds them, and COLMAP is the program
# that most captures come from. It works in four steps:
#
# 1. **Features**: find some thousand corners and blobs in each photograph, and describe what each looks like.
# 2. **Matches**: find the same feature in several photographs. A chain of matches is a *track*.
# 3. **Poses and points**: from two photographs with many matches, compute how one camera stands to the other, and where
#    the matched features lie in space (*triangulation*). Add the other photographs one after another.
# 4. **Bundle adjustment**: move all poses and all points until each point, projected by each camera, falls on the
#    feature it came from. The distance that is left is the *reprojection error*, usually half a pixel to one.
#
# The heart of it fits in a few lines. A feature at pixel $u$ says that the point lies on a ray, $u \times (K p) = 0$ in
# homogeneous coordinates: two linear equations for its three coordinates. Two photographs give four equations; ten give
# twenty, and least squares take care of their errors. Below, each feature is half a pixel off.


# %%
def pixels_of(view, points):
    """Project points: px, and their depths."""
    p = points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    return (p @ view.K.T)[:, :2] / p[:, 2:], p[:, 2]


def triangulated(views, pixels):
    """Find the point that is seen at these pixels, by least squares."""
    equations = []
    for view, (u, v) in zip(views, pixels, strict=True):
        P = view.K @ view.viewmat[:3]
        equations += [u * P[2] - P[0], v * P[2] - P[1]]
    *_, Vt = np.linalg.svd(np.array(equations))
    return Vt[-1, :3] / Vt[-1, 3]


rng = np.random.default_rng(0)
truth = np.array([[0.1, 0.05, 0.15]])
errors = {}
for n_views in (2, 4, 12):
    off = []
    for _ in range(50):
        chosen = [capture.views[k] for k in rng.choice(12, n_views, replace=False)]
        seen = [pixels_of(view, truth)[0][0] + rng.normal(0.0, 0.5, 2) for view in chosen]
        off.append(np.linalg.norm(triangulated(chosen, seen) - truth[0]))
    errors[n_views] = float(np.median(off))
    print(f"{n_views:2} photographs: the point is off by {errors[n_views]:.4f}")
assert errors[12] < errors[4] < errors[2]

# %% [markdown]
# What COLMAP leaves is a folder: `images/` with the photographs, and `sparse/0/` with three files that
# matter here. (Since version 3.12 it also writes `frames.bin` and `rigs.bin`, for cameras that are mounted together.)
#
# | file | a record holds |
# |---|---|
# | `cameras.bin` | number, model of the lens, width, height, parameters ($f_x, f_y, c_x, c_y$ and distortion) |
# | `images.bin` | number, quaternion (w first) and $t$ of the pose, number of the camera, file name, its features |
# | `points3D.bin` | number, position, colour, reprojection error, and its track: which feature of which image |
#
# Real lenses bend straight lines, and splatting knows pinholes only; so photographs are *undistorted* first, that is
# resampled as a pinhole would have taken them. `pop data check FOLDER` tells what a capture has and what is wrong with
# it, and `pop train` on a bare folder of photographs runs structure from motion itself.

# %%
print(*files, sep="\n")
assert {"cameras.bin", "images.bin", "points3D.bin"} <= {Path(each).name for each in files}
at, depths = pixels_of(view, capture.points)
# mix-ups of the first table: OpenGL's axes show what is behind, the inverse another view, a corner a shifted one
open_gl, inverse = (
    replace(view, viewmat=pose) for pose in (flip @ view.viewmat, np.linalg.inv(view.viewmat))
)
by_corner = replace(view, K=view.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]))
assert np.allclose(pixels_of(open_gl, capture.points)[1], -depths)
assert np.median(np.abs(pixels_of(inverse, capture.points)[0] - at)) > 10.0
assert np.allclose(pixels_of(by_corner, capture.points)[0], at - 0.5)
inside = (depths > 0) & np.all((at > 0) & (at < [view.width, view.height]), axis=1)
print(f"{len(capture.points)} points, {inside.sum()} of them in photograph 0,", end=" ")
print(f"at depths {depths[inside].min():.1f} to {depths[inside].max():.1f}")

fig, (left, right) = axes(2, height=2.9, ticks=False, width_ratios=[1.25, 1])
show_image(left, view.image / 255.0, "photograph 0 and the points")
left.scatter(*at[inside].T, s=5, c=ACCENT, lw=0)
left.set(xlim=(0, view.width), ylim=(view.height, 0))
right.scatter(*capture.points[:, :2].T, s=3, c=capture.points_rgb / 255.0, lw=0)
for k, each in enumerate(capture.views):
    forward = each.viewmat[2, :3]
    right.plot(*each.camera_center[:2], "o", ms=4, color=SECOND if k == 0 else INK)
    right.arrow(*each.camera_center[:2], *(0.25 * forward[:2]), color=MUTED, head_width=0.04)
right.set(aspect="equal", title="from above")
picture(
    fig,
    "Left: where the points fall in a photograph. Right: the points and the cameras; orange took it.",
)

# %% [markdown]
# ## Units that mean nothing
#
# From photographs alone one cannot tell a dolls' house from a house: the unit of the world is arbitrary. What training
# measures in world units has to follow it. The capture's *scene scale*, about the radius of the circle on which the
# cameras stand, is that unit: the learning rate of positions is multiplied by it, and "small", in clone and split,
# means under a hundredth of it.

# %%
centers = np.array([each.camera_center for each in capture.views])
radius = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
print(
    f"scene scale {capture.scene_scale():.3f},",
    f"rate of positions {learning_rates(0, capture.scene_scale())['means']:.2e}",
)
assert np.isclose(capture.scene_scale(), 1.1 * radius)

# %% [markdown]
# ## From points to Gaussians
#
# Each point becomes one Gaussian (3DGS, section 5.1, as gsplat does it):
#
# - **centre**: the point; **rotation**: none, or any, since the Gaussian begins round;
# - **colour**: $h_0 = (c - \frac12) / Y_0$ so that it looks as the point does; all higher harmonics 0;
# - **opacity**: 0.1. Faint enough that light reaches what is behind, so that every Gaussian gets a gradient;
# - **width**: the distance to its neighbours, so that together they just cover the surface: the root of the mean
#   squared distance to the three nearest points.

# %%
squared = np.sum((capture.points[:, None] - capture.points) ** 2, axis=2)
# the nearest to a point is the point itself
widths = np.sqrt(np.sort(squared, axis=1)[:, 1:4].mean(axis=1))
print(f"widths: median {np.median(widths):.3f}, from {widths.min():.3f} to {widths.max():.3f}")


def first_scene(factor=1.0, opacity=0.1):
    """Make the Gaussians that a training begins with; widths are multiplied by a factor."""
    n = len(capture.points)
    return Gaussians(
        means=capture.points,
        quats=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        scales=np.tile(factor * widths[:, None], (1, 3)),
        opacities=np.full(n, opacity),
        sh=((capture.points_rgb / 255.0 - 0.5) * np.sqrt(4 * np.pi))[:, None],
    )


# a quarter of the resolution is enough to see it
K = view.K * [[0.5], [0.5], [1.0]]
half = Camera(view.viewmat, K, 40, 30)
grey = np.full(3, 0.6)
drawn = {factor: render(first_scene(factor), half, grey) for factor in (0.25, 1.0, 3.0)}
fig, panels = axes(4, height=1.7, ticks=False)
show_image(panels[0], view.image / 255.0, "photograph")
for panel, (factor, each) in zip(panels[1:], drawn.items(), strict=True):
    show_image(panel, each.image, f"widths × {factor:g}")
picture(
    fig,
    "The first Gaussians with a quarter of these widths, with them, and with three times as much.",
)
for factor, each in drawn.items():
    light, blended = each.T_final.mean(), each.n_blended.mean()
    print(f"widths x {factor:<4g}  light left {light:.2f}, blended per pixel {blended:.0f}")
light = [each.T_final.mean() for each in drawn.values()]
assert light == sorted(light, reverse=True)

# %% [markdown]
# Too small, and most pixels see the background: what no splat covers has no gradient, so no Gaussian grows into it. Too
# large, and everything is fog: each Gaussian covers half the picture, and all are pulled by the same pixels. The rule
# of the three neighbours is right wherever points lie evenly on a surface, and wrong for a lonely point in the sky;
# training repairs it.

# %% [markdown]
# ### Exercise 1: predict
# A user halves the photographs (80 by 60 to 40 by 30) to train faster, and leaves $K$ as it was. What does the first
# picture show? Which four numbers have to be halved?

# %% answer
# The upper left quarter of the view, as if zoomed in twice. $f_x, f_y, c_x, c_y$ are in pixels and have to be halved;
# the pose has no pixels in it and stays.
wrong = render(first_scene(), Camera(view.viewmat, view.K, 40, 30), grey).image
full = render(first_scene(), Camera(view.viewmat, view.K, 80, 60), grey).image
print("the same as a quarter of the whole view:", np.allclose(wrong, full[:30, :40], atol=0.05))
assert np.abs(wrong - full[:30, :40]).mean() < 0.01 < np.abs(wrong - drawn[1.0].image).mean()

# %% [markdown]
# ### Exercise 2: derive
# The unit of the world is made ten times smaller, so that all positions, and the $t$ of all poses, become ten times
# larger. What must happen to scales, opacities, colours and the learning rates, so that a training does exactly the
# same?

# %% answer
# Scales become ten times larger, that is their logarithms grow by $\ln 10$, and *their* learning rate stays, since it
# is a rate of the logarithm. The rate of positions becomes ten times larger, which the scene scale takes care of.
# Opacities and colours do not know the unit. The picture is the same to the last bit or so.
base = first_scene()
larger = Gaussians(10 * base.means, base.quats, 10 * base.scales, base.opacities, base.sh)
pose = view.viewmat.copy()
pose[:3, 3] *= 10
image = render(larger, Camera(pose, K, 40, 30), grey).image
assert np.allclose(image, drawn[1.0].image, atol=1e-9)
rates = [learning_rates(0, scale) for scale in (1.0, 10.0)]
assert np.isclose(rates[1]["means"], 10 * rates[0]["means"])
assert rates[1]["scales"] == rates[0]["scales"]

# %% [markdown]
# ### Exercise 3: code
# Write `look_at(eye, target, up)` that gives the viewmat of a camera at `eye` which looks at `target`, with x right, y
# down and z forward. Test it: the target must fall on the middle of the picture, and a point above it must fall above.


# %% answer
# The rows of $R_c$ are the camera's axes in the world: right, down, forward. $t = -R_c \cdot \text{eye}$.
def look_at(eye, target, up):
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = right, down, forward
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return viewmat


mine = look_at(np.array([2.0, 1.0, 1.5]), np.array([0.0, 0.0, 0.3]), np.array([0.0, 0.0, 1.0]))
middle, above = (
    mine[:3, :3] @ point + mine[:3, 3] for point in ([0.0, 0.0, 0.3], [0.0, 0.0, 0.6])
)
print("target", middle.round(3), " above it", above.round(3))
assert np.allclose(middle[:2], 0.0)
assert above[1] < 0.0 < middle[2]
assert np.isclose(np.linalg.det(mine[:3, :3]), 1.0)

# %% [markdown]
# ### Exercise 4: find the bug
# The place of a camera is needed for the direction of view. What is wrong here, and for which cameras is it right?
#
# {{bug: camera_in_world_axes}}

# %% answer
# $-t$ is the centre in the *camera's* axes; it has to be turned back, $-R_c^\top t$. It is right for cameras that are
# not turned. With the others, colours that depend on the direction come out wrong, which looks like a bad training.
print(caught("camera_in_world_axes"))
