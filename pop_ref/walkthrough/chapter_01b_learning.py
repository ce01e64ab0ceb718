# minutes: 40

# %% [markdown]
# # 1b. How a splat learns: raw parameters, gradient descent, Adam, vjps
#
# Training changes the numbers of the Gaussians until their picture is right. At the end of this chapter you know which
# numbers are changed, in which direction, how far, and how a program finds the direction: enough to read every later
# chapter's code that ends in `_vjp`, and enough to train one splat here.
#
# ## Numbers that may take any value
#
# An opacity lies between 0 and 1, a width is positive, a rotation's quaternion has length 1. An optimizer knows none of
# this: it adds and subtracts. So what is stored are *raw parameters*, which may be any number, and a function brings
# them into range:
#
# | what is stored | what is used | by | and back |
# |---|---|---|---|
# | log of a width | width, positive | $s = e^x$ | $x = \ln s$ |
# | *logit* of an opacity | opacity, in (0, 1) | the sigmoid $o = 1 / (1 + e^{-x})$ | $x = \ln \frac{o}{1 - o}$ |
# | any four numbers | unit *quaternion*, a rotation | $u = q / \lvert q \rvert$ | $q = u$ |
# | a colour's coefficients | a colour | a sum (chapter 3) | |
# | a centre | the same | nothing | |
#
# A quaternion is four numbers $(w, x, y, z)$ for a rotation: by the angle $\theta$ about the unit axis $a$ it is
# $(\cos \frac{\theta}{2}, a \sin \frac{\theta}{2})$. Chapter 2 turns it into a matrix.
#
# {{source: pop_ref.activations.opacities_from_logits}}

# %%
from collections.abc import Callable

import numpy as np

from pop_ref.activations import (
    opacities_from_logits,
    opacities_from_logits_vjp,
    scales_from_log_scales,
    unit_quats_from_quats,
    unit_quats_from_quats_vjp,
)
from pop_ref.losses import l2, l2_vjp
from pop_ref.optimizer import adam_step
from pop_ref.records import Camera
from pop_ref.render import render, render_vjp
from pop_ref.training import gaussians_from_params, params_vjp
from pop_ref.walkthrough.bugs import caught
from pop_ref.walkthrough.pages import film, picture
from pop_ref.walkthrough.style import ACCENT, MUTED, SECOND, axes

logits = np.array([-6.0, -2.2, 0.0, 2.2, 6.0])
print("logits:   ", logits)
print("opacities:", opacities_from_logits(logits).round(3))
print("widths of -2, 0, 2:", scales_from_log_scales(np.array([[-2.0, 0.0, 2.0]])).round(3))
assert np.allclose(opacities_from_logits(logits), 1 / (1 + np.exp(-logits)))

x = np.linspace(-7, 7, 300)
o = opacities_from_logits(x)
fig, (left, right) = axes(2, height=2.6)
left.plot(x, o, color=ACCENT, label="opacity")
left.plot(x, o * (1 - o), color=SECOND, label="how fast it changes, $o(1-o)$")
left.set(xlabel="logit", title="the sigmoid", ylim=(-0.05, 1.5))
left.legend(loc="upper left")
right.plot(o, o * (1 - o), color=SECOND)
right.set(xlabel="opacity", title="how fast it changes with its logit")
picture(
    fig,
    "Near 0 and 1 an opacity hardly changes with its logit: it can come as near to them as it likes, and never leaves "
    "the range.",
)

# %% [markdown]
# Two more reasons speak for raw parameters. A step of 0.1 in a logarithm is about ten percent, for a width of a
# millimetre as for one of ten metres. And the sum of two raw parameters is one, too, so no step has to be checked.
#
# ## Gradient descent
#
# Call the loss $L(x)$: a number that is small when the picture is right. Its *gradient* $\nabla L$ holds one derivative
# for each parameter and points to where $L$ rises fastest. So go a little in the other direction, again and again:
#
# $$x \leftarrow x - \eta \, \nabla L(x)$$
#
# $\eta$ is the *learning rate*. If it is too small, nothing happens; if it is too large, each step jumps over the
# minimum and lands farther away than it came from. The trouble is that one $\eta$ must suit all parameters. Take a
# valley that is a hundred times steeper in one direction than in the other, as when $x_1$ is a position in metres and
# $x_2$ a logit:

# %%
STEEP = np.array([100.0, 1.0])


def valley(x: np.ndarray) -> float:
    return float(0.5 * STEEP @ (x * x))


def walk(update: Callable, n: int) -> np.ndarray:
    """Go n steps from (1, -2); return the places."""
    places = [np.array([1.0, -2.0])]
    for step in range(1, n + 1):
        places.append(update(places[-1], STEEP * places[-1], step))
    return np.array(places)


def descent(rate: float) -> Callable:
    return lambda x, gradient, step: x - rate * gradient


just_right, too_large = walk(descent(0.019), 60), walk(descent(0.0202), 60)
print("after 60 steps at rate 0.019: ", just_right[-1].round(3))
print("after 60 steps at rate 0.0202:", too_large[-1].round(3))
assert valley(just_right[-1]) < valley(just_right[0])
assert abs(too_large[-1, 0]) > 3.0
assert abs(just_right[-1, 0]) < 0.01
assert round(abs(just_right[-1, 1]) / 2.0, 1) == 0.3

# %% [markdown]
# At 0.019 the steep coordinate jumps to and fro and slowly settles, while the flat one hardly moves: after sixty steps
# it has a third of its way to go. At 0.0202 the walk diverges.
#
# ## Adam
#
# *Adam* gives each parameter its own measure. It keeps two running means of each parameter's gradient $g$, of its value
# and of its square, and steps by their quotient (Kingma and Ba 2015, algorithm 1):
#
# $$m \leftarrow \beta_1 m + (1 - \beta_1)\, g, \qquad v \leftarrow \beta_2 v + (1 - \beta_2)\, g^2, \qquad
# x \leftarrow x - \eta \, \frac{m / (1 - \beta_1^t)}{\sqrt{v / (1 - \beta_2^t)} + \epsilon}$$
#
# with $\beta_1 = 0.9$, $\beta_2 = 0.999$, at step $t = 1, 2, \dots$ Both start at 0; the divisions by $1 - \beta^t$
# make up for it. While the gradient keeps its sign and size, the quotient is 1 and the step $\eta$: **the learning rate
# is the length of a step**, in the parameter's own unit, however steep the loss. Where the sign changes to and fro, $m$
# averages out and the steps get short.
#
# {{source: pop_ref.optimizer.adam_step}}


# %%
def adam(rate: float) -> Callable:
    state = {"m": {"x": np.zeros(2)}, "v": {"x": np.zeros(2)}}

    def update(x: np.ndarray, gradient: np.ndarray, step: int) -> np.ndarray:
        grads = {"x": gradient}
        moved, state["m"], state["v"] = adam_step(
            {"x": x}, grads, state["m"], state["v"], step, lr={"x": rate}
        )
        return moved["x"]

    return update


with_adam = walk(adam(0.1), 60)
print("after 60 steps of Adam:       ", with_adam[-1].round(3))
assert valley(with_adam[-1]) < valley(just_right[-1])
assert np.allclose(np.abs(with_adam[1] - with_adam[0]), 0.1)

fig, (left, right) = axes(2, height=2.8, width_ratios=[1.3, 1])
a, b = np.meshgrid(np.linspace(-1.3, 1.3, 80), np.linspace(-2.3, 0.8, 80))
bowl, heights = 50 * a * a + 0.5 * b * b, [0.5, 1, 2, 5, 10, 20, 40, 80]
left.contour(a, b, bowl, levels=heights, colors=MUTED, linewidths=0.6)
for places, shade, name in (
    (just_right, SECOND, "gradient descent"),
    (with_adam, ACCENT, "Adam"),
):
    left.plot(*places.T, ".-", color=shade, lw=1, ms=4, label=name)
    right.semilogy([valley(place) for place in places], color=shade, label=name)
left.set(xlabel="$x_1$, steep", ylabel="$x_2$, flat")
right.set(xlabel="step", title="loss")
right.legend()
picture(
    fig, "Sixty steps in a valley that is a hundred times steeper along $x_1$ than along $x_2$."
)

# %% [markdown]
# ## The small number at the end
#
# $\epsilon$ keeps the quotient finite where a gradient is 0. It also decides what counts as no gradient at all: where
# the gradient is much smaller than $\epsilon$, steps are much shorter than $\eta$. torch's default is $10^{-8}$; the
# programs of 3DGS and gsplat use $10^{-15}$. The losses here are means over a whole image, so the gradient of one
# Gaussian is often under $10^{-8}$, and the choice matters: with $10^{-15}$, Gaussians that next to no pixel shows
# still move at full speed. Chapter 8 is about what comes of that.

# %%
sizes = 10.0 ** np.arange(-20.0, 1.0)


def first_step(gradient: float, eps: float) -> float:
    zero = {"x": np.zeros(1)}
    moved, _, _ = adam_step(
        zero, {"x": np.array([gradient])}, zero, zero, 1, {"x": 1.0}, eps=eps
    )
    return float(-moved["x"][0])


steps = {eps: np.array([first_step(size, eps) for size in sizes]) for eps in (1e-15, 1e-8)}
print(
    "gradient 1e-10: step of", *(f"{first_step(1e-10, eps):.3f} (eps {eps:g})" for eps in steps)
)
assert np.allclose(first_step(1e-10, 1e-15), 1.0, rtol=1e-4)
assert np.isclose(first_step(1e-10, 1e-8), 1 / 101)

fig, ax = axes(1, width=5.0, height=2.5)
for (eps, length), shade in zip(steps.items(), (ACCENT, SECOND), strict=True):
    ax.semilogx(sizes, length, ".-", color=shade, label=rf"$\epsilon$ = {eps:g}")
ax.set(xlabel="size of the gradient", ylabel="first step / learning rate")
ax.legend(loc="center right")
picture(fig, "To Adam a gradient has a sign and hardly a size, down to about $\\epsilon$.")

# %% [markdown]
# ## Where the gradient comes from: the vjp
#
# A renderer is a chain of functions, and the loss is its last link. For one splat at one pixel:
#
# $$\text{logit } x \;\to\; \text{opacity } o \;\to\; \text{alpha } \alpha \;\to\; \text{colour } C \;\to\;
# \text{loss } L$$
#
# By the chain rule $\frac{dL}{dx}$ is a product, and the clever way to compute it is from the right. Start with
# $\frac{dL}{dC}$; multiply by $\frac{dC}{d\alpha}$ and you have $\frac{dL}{d\alpha}$; and so on down to the parameter.
# At each link you need nothing but what came from its right and the link's own derivative.
#
# The gradient of the loss with respect to $y$ is called the *cotangent* of $y$ and written `v_y`. A link $y = f(x)$ in
# several variables has a matrix of derivatives, its *Jacobian* $J_{ij} = \partial y_i / \partial x_j$, and the rule is
#
# $$v_x = J^\top v_y .$$
#
# The function that computes it is the *vjp* of $f$, its vector-Jacobian product. In `pop_ref` each function `f` has its
# `f_vjp` next to it, which takes what `f` took and the cotangent of what `f` gave, and returns the cotangents of what
# `f` took. $J$ is never written down: it would have a row for every number of the image and a column for every
# parameter. Training calls all functions forwards, and then all their vjps backwards.
#
# {{source: pop_ref.activations.opacities_from_logits_vjp}}
#
# On paper: a white splat over black, right over the pixel, with logit 0; the photograph says 0.8. Then $o = \alpha = C
# = \frac12$ and $L = (C - 0.8)^2 = 0.09$. Backwards: $v_C = 2 (C - 0.8) = -0.6$; $v_\alpha = -0.6$, since $C = \alpha$;
# $v_o = -0.6$; and $v_x = o (1 - o)\, v_o = -0.15$. The loss falls when the logit grows, as it should.

# %%
logit, wish = np.array([0.0]), 0.8
o = opacities_from_logits(logit)
v_color = 2.0 * (o - wish)
v_logit = opacities_from_logits_vjp(logit, v_color)
print("v_color", v_color, " v_logit", v_logit)
assert np.isclose(v_logit[0], -0.15)

# the same by a small difference
h = 1e-6
above, below = ((opacities_from_logits(logit + d) - wish) ** 2 for d in (h, -h))
print("by a difference", (above - below) / (2 * h))
assert np.isclose((above - below)[0] / (2 * h), v_logit[0])

# %% [markdown]
# ## One splat learns
#
# Everything together. A blue splat has to become the orange one, from nothing but the picture. The loss is the mean
# squared difference (chapter 6); `render` and `render_vjp` are the whole renderer and its vjp, which the chapters up to
# 5b take apart. Note the order: forwards, compare, backwards, step.

# %%
camera = Camera(np.eye(4), np.array([[32.0, 0, 12.0], [0, 32.0, 8.0], [0, 0, 1.0]]), 24, 16)


def one(x, y, widths, quaternion, opacity, color):
    """Write the raw parameters of one Gaussian at depth 4."""
    return {
        "means": np.array([[x, y, 4.0]]),
        "quats": np.array([quaternion]),
        "scales": np.log([widths]),
        "opacities": np.log([opacity / (1 - opacity)]),
        "sh0": (np.array([[color]]) - 0.5) / 0.28209479177387814,
    }


def drawn(params):
    return render(gaussians_from_params(params), camera, background=np.ones(3)).image


target = drawn(one(0.45, -0.2, [0.5, 0.2, 0.2], [0.95, 0.0, 0.0, 0.3], 0.9, [0.95, 0.55, 0.1]))
first = one(-0.3, 0.2, [0.25, 0.3, 0.2], [1.0, 0.0, 0.0, 0.1], 0.5, [0.2, 0.4, 0.9])
rates = {"means": 0.02, "quats": 0.03, "scales": 0.04, "opacities": 0.08, "sh0": 0.08}


def learned(params, n_steps=90):
    """Train one splat; return its parameters before every step and at the end, and the losses."""
    m, v = ({name: np.zeros_like(value) for name, value in params.items()} for _ in range(2))
    path, losses = [params], []
    for step in range(1, n_steps + 1):
        image = drawn(params)
        losses.append(l2(image, target))
        v_image = l2_vjp(image, target, 1.0)
        gradients = render_vjp(
            gaussians_from_params(params), camera, v_image, background=np.ones(3)
        )
        grads = params_vjp(params, gradients, np.zeros(1))
        params, m, v = adam_step(params, grads, m, v, step, rates)
        path.append(params)
    return path, losses


path, losses = learned(first)
shown = [0, *range(6, 90, 6), 90]
frames = [np.concatenate([drawn(path[step]), target], axis=1) for step in shown]
last = path[-1]
print(f"loss {losses[0]:.4f} at first, {losses[-1]:.6f} before the last step")
print("target: opacity 0.90, widths 0.50 0.20 0.20, depth 4.00")
print(f"found:  opacity {opacities_from_logits(last['opacities'])[0]:.2f}, widths", end=" ")
print(*np.exp(last["scales"])[0].round(2), f" depth {last['means'][0, 2]:.2f}", sep=" ")
assert losses[-1] < 0.02 * losses[0]
film(
    frames,
    [f"step {step}" for step in shown],
    "Left the splat that learns, right its target.",
    enlarged=12,
)

# %% [markdown]
# In ninety steps one rule has changed five kinds of numbers. **The picture fits, and the parameters do not.** A larger
# splat farther away looks the same, so the depth is free to be wrong. A fainter one that is a little wider looks almost
# the same, so the opacity comes only near. And the third width lies along the line of sight, where the camera hardly
# sees it. What the photograph does not determine is not left alone, either: its gradient is tiny and not zero, Adam
# makes full steps of it, and the number *drifts*. Where it ends depends on where it began. Two other starts show it:

# %%
for third_width, place in ((0.05, -0.3), (0.4, -0.1)):
    other = one(
        place, 0.2, [0.25, 0.3, third_width], [1.0, 0.0, 0.0, 0.1], 0.5, [0.2, 0.4, 0.9]
    )
    other_path, other_losses = learned(other)
    widths = np.exp(other_path[-1]["scales"])[0]
    depth = other_path[-1]["means"][0, 2]
    print(f"third width {third_width} at first, {widths[2]:.3f} at the end; depth {depth:.2f}")
    # it fits as well, ...
    assert other_losses[-1] < 0.02 * other_losses[0]
    # ... and is another splat: neither the target's nor the one that was found before
    assert abs(widths[2] - np.exp(last["scales"])[0, 2]) > 0.005
    assert abs(widths[2] - third_width) > 0.02
    assert abs(depth - 4.0) > 0.02
assert abs(opacities_from_logits(last["opacities"])[0] - 0.9) > 0.05

# %% [markdown]
# A single photograph cannot know depth and the width along the line of sight. That is why one takes many.

# %% [markdown]
# ### Exercise 1: predict
# Adam has learning rate 0.05 and starts. The first gradient that a parameter sees is 1000. How far does it move? And
# another parameter, whose first gradient is $-10^{-9}$?

# %% answer
# By 0.05 down, and by 0.05 up: at the first step $m / (1 - \beta_1) = g$ and $\sqrt{v / (1 - \beta_2)} = \lvert g
# \rvert$, so only the sign is left (as long as $\lvert g \rvert$ is large compared with $\epsilon = 10^{-15}$).
zero = {"x": np.zeros(2)}
moved, _, _ = adam_step(zero, {"x": np.array([1000.0, -1e-9])}, zero, zero, 1, {"x": 0.05})
print(moved["x"])
assert np.allclose(moved["x"], [-0.05, 0.05])

# %% [markdown]
# ### Exercise 2: derive
# A quaternion is divided by its length before it is used, $u = q / \lvert q \rvert$. Derive the vjp, and show that
# $v_q$ is perpendicular to $q$. What does that mean for training?

# %% answer
# $du = (dq - u\,(u \cdot dq)) / \lvert q \rvert$, a symmetric matrix times $dq$, so $v_q = (v_u - u\,(u \cdot v_u)) /
# \lvert q \rvert$. The part along $q$ is taken out: making $q$ longer turns nothing, so the loss does not ask for it. A
# step perpendicular to $q$ makes it longer all the same, a little each time; the division takes care of that, too.
q, v_u = np.array([[0.3, -1.0, 2.0, 0.4]]), np.array([[0.5, 0.1, -0.2, 1.0]])
u, length = unit_quats_from_quats(q), np.linalg.norm(q)
v_q = (v_u - u * np.sum(u * v_u)) / length
assert np.allclose(v_q, unit_quats_from_quats_vjp(q, v_u))
assert abs(np.sum(q * v_q)) < 1e-15

# %% [markdown]
# ### Exercise 3: code
# Write the vjp of $y = x_1 x_2$ and of $y = \ln x$, and from them the gradient of $\ln(x_1 x_2)$, without simplifying
# the formula first. Check it by a difference.


# %% answer
# Forwards: $p = x_1 x_2$, $y = \ln p$. Backwards: $v_p = v_y / p$, then $v_{x_1} = x_2 v_p$ and $v_{x_2} = x_1 v_p$.
def product_vjp(x1, x2, v_y):
    return x2 * v_y, x1 * v_y


def log_vjp(x, v_y):
    return v_y / x


found = product_vjp(3.0, 5.0, log_vjp(3.0 * 5.0, 1.0))
print(found)
assert np.allclose(found, [1 / 3, 1 / 5])
assert np.isclose((np.log((3.0 + h) * 5.0) - np.log((3.0 - h) * 5.0)) / (2 * h), found[0])

# %% [markdown]
# ### Exercise 4: find the bug
# Below is the oracle's Adam with one mistake. Which line is it, and what would you see in a training?
#
# {{bug: adam_without_bias_correction}}

# %% answer
# $m$ is not divided by $1 - \beta_1^t$. It starts at 0 and has only a tenth of the first gradient, so the first steps
# are a tenth of what they should be. A training would only look a little slow at the start, and it would not be noticed
# without a law that measures the first step.
print(caught("adam_without_bias_correction"))
