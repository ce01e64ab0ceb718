# minutes: 25

# %% [markdown]
# # 12. Break it: each mutant, and the law that catches it
#
# A test must fail where the program is wrong, and this can be tried. The kit that judges rasterizers is judged itself
# by broken copies of the oracle, each wrong in one line. At the end of this chapter you have seen what such bugs do to
# a picture, that most of them do nothing to it, and which law catches which.
#
# ## A law and a mutant
#
# A **law** is a sentence that must hold for every input: doubling all scales quadruples the covariance; a pixel that no
# splat reaches has no dominant Gaussian. The kit draws inputs and looks for one that breaks it. A **mutant** is the
# oracle with one line replaced. `living` imports it under another name, so that it and the oracle can be asked the
# same. Here is one of each: an alpha that equals the floor is blended (decision D5), and a copy in which it is not.

# %%
import inspect
import textwrap

import numpy as np

from pop_ref.conformance.adapter import OracleAdapter
from pop_ref.conformance.mutants import MUTANTS, Mutant, living
from pop_ref.conformance.mutants.trial import every_law, killed_by, law_named, obeys
from pop_ref.conformance.scenes import Record, Scene, pack
from pop_ref.records import Camera
from pop_ref.walkthrough.bugs import caught
from pop_ref.walkthrough.pages import picture
from pop_ref.walkthrough.style import ACCENT, INK, MUCH, SECOND, THIRD, axes, show_image

BY_NAME = {mutant.name: mutant for mutant in MUTANTS}

mutant = BY_NAME["floor_skipped"]
print(f"{mutant.file}\n- {mutant.old}\n+ {mutant.new}\n")
print(inspect.getsource(law_named(mutant.law).sentence))
assert obeys(law_named(mutant.law), OracleAdapter()) is None, "the oracle obeys"
assert killed_by(mutant) is not None, "the mutant does not"

# %% [markdown]
# ## What bugs look like
#
# One scene, drawn by the oracle and by every mutant: a long splat turned by 40 degrees, a round one whose colour
# depends on the direction of view, a thin one, one that ends just inside a tile, one behind the camera, all before
# grey. The formulas that these mutants get wrong are the covariance $\Sigma = R S S^\top R^\top$ (3DGS, section 4), the
# alpha of the POP paper's eq. 11, and the blending of its eq. 1.

# %%
WIDTH, HEIGHT = 32, 24
turn = np.deg2rad(25.0)
viewmat = np.eye(4)
viewmat[:3, :3] = np.array(
    [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
)
viewmat[:3, 3] = [0.3, -0.2, 0.5]
K = np.array([[30.0, 0.0, WIDTH / 2], [0.0, 30.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
camera = Camera(viewmat, K, WIDTH, HEIGHT)
tilted = (np.cos(np.deg2rad(20.0)), 0.0, 0.0, np.sin(np.deg2rad(20.0)))
sideways = ((0.9, 0.3, -0.6), (0.8, 0.8, -0.8), (0.0, 0.0, 0.0), (0.5, -0.5, 0.5))
records = [
    Record(9.0, 9.0, 3.0, (5.0, 1.2, 1.2), tilted, 0.9, ((1.2, -0.4, -1.0),)),
    Record(22.0, 7.0, 4.0, (2.5, 2.5, 2.5), opacity=0.95, sh=sideways),
    Record(12.5, 18.0, 5.0, (4.0, 0.25, 0.25), opacity=0.99, sh=((-1.0, 0.6, -0.2),)),
    Record(23.0, 18.0, 2.0, (2.2, 1.5, 1.5), opacity=0.7, sh=((-1.2, -0.8, 0.9),)),
    Record(5.0, 19.0, -3.0, (2.0, 2.0, 2.0), opacity=0.9, sh=((1.5, 1.5, -1.5),)),
]
scene = Scene(pack(records, camera), camera, background=np.array([0.75, 0.75, 0.75]))
true = OracleAdapter().render(scene)


def drawn_by(mutant):
    """Return the scene as a mutant draws it."""
    with living(mutant) as backend:
        return backend.render(scene)


views = {mutant.name: drawn_by(mutant) for mutant in MUTANTS}
off = {name: np.abs(view.image - true.image).max(axis=2) for name, view in views.items()}
visible = [name for name in off if off[name].max() > 0.0]
print(f"{len(visible)} of {len(MUTANTS)} mutants change a pixel of this picture")
assert len(visible) < len(MUTANTS) / 2

shown = ("xyzw", "jacobian_sign", "low_pass_after_inversion", "half_pixel_shift")
shown += ("background_not_scaled", "seen_from_behind", "edge_exact_splat_dropped")
fig, panels = axes(4, 4, height=6.2, ticks=False)
show_image(panels[0], true.image, "the oracle")
panels[4].axis("off")
for place, name in zip((1, 2, 3, 8, 9, 10, 11), shown, strict=True):
    show_image(panels[place], views[name].image, name.replace("_", " "))
    show_image(panels[place + 4], off[name], vmin=0.0, vmax=0.5)
for panel in panels:
    panel.title.set_fontsize(7.5)
picture(
    fig,
    "Seven mutants; under each, the largest difference of a channel from the oracle's picture, up to 0.5 in yellow.",
)
assert all(off[name].max() > 0.05 for name in shown)

# %% [markdown]
# ## What bugs do not look like
#
# Most mutants draw this scene to the last bit as the oracle does. Some wait for another scene: two splats at one depth,
# an alpha that is the floor exactly. Others are wrong in what a picture does not show: gradients, the dominant
# Gaussian, what Adam remembers. A training may converge all the same, only worse. Three of them, seen through the
# gradients of the opacities of the four splats before the camera.

# %%
v_image = np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 3))
zero = np.zeros((HEIGHT, WIDTH))
quiet = ("stale_last_contributor", "background_behind_forgotten", "weight_above_one")
pulls = {"the oracle": OracleAdapter().gradients(scene, v_image, zero)["opacities"][:4]}
for name in quiet:
    assert off[name].max() == 0.0
    with living(BY_NAME[name]) as backend:
        pulls[name] = backend.gradients(scene, v_image, zero)["opacities"][:4]
    assert not np.allclose(pulls[name], pulls["the oracle"], rtol=0.01)

fig, ax = axes(1, height=2.4)
for k, (name, color) in enumerate(zip(pulls, (INK, ACCENT, SECOND, THIRD), strict=True)):
    places = np.arange(4) + 0.2 * (k - 1.5)
    ax.bar(places, pulls[name], 0.18, color=color, label=name.replace("_", " "))
ax.set(xticks=range(4), xticklabels=("long", "round", "thin", "at the tile's edge"))
ax.set_ylabel("gradient of the opacity")
ax.legend(fontsize=8)
picture(fig, "One picture, four gradients. Only the first belongs to it.")

# %% [markdown]
# ## Laws live
#
# Now the trial. Each mutant names the law that must break on it; `killed_by` brings it to life, tries that law, and
# returns how it broke, or `None` if the mutant survives. Below, mutants are tried on each other's laws as well. A law
# speaks about one thing, so a bug breaks its own law and leaves most others alone: that is how a report of broken laws
# points at the line.

# %%
tried = ("xyzw", "covariance_of_the_inverse_rotation", "variance_for_deviation")
tried += ("two_ceilings", "leaking_ceiling", "edge_exact_splat_dropped", "unstable_sort")
tried += ("tie_to_the_back", "prior_over_all", "prior_pushes_the_wrong_way")
tried += ("moments_left_behind", "clones_inherit_moments", "adam_without_bias_correction")
laws = [BY_NAME[name].law for name in tried]
broken = np.zeros((len(tried) + 1, len(laws)), dtype=bool)


def breaks_of(backend):
    """Tell which laws break on a backend, each tried on 12 inputs."""
    return [obeys(law_named(law), backend, examples=12) is not None for law in laws]


broken[0] = breaks_of(OracleAdapter())
for row, name in enumerate(tried, start=1):
    with living(BY_NAME[name]) as backend:
        broken[row] = breaks_of(backend)
assert not broken[0].any(), "the oracle obeys all"
assert np.diag(broken[1:]).all(), "every mutant breaks its own law"

fig, ax = axes(1, height=3.9)
ax.imshow(broken, aspect="auto", cmap=MUCH, vmin=0, vmax=1.2)
numbered = [f"{name.replace('_', ' ')}  {k}" for k, name in enumerate(tried, start=1)]
ax.set_yticks(range(len(tried) + 1), ["the oracle", *numbered])
ax.set_xticks(range(len(laws)), [str(k + 1) for k in range(len(laws))])
ax.set(xlabel="law that is named for mutant k")
ax.grid(False)
picture(
    fig,
    "Blue: the law breaks. The oracle breaks none, every mutant its own. Mutants 4 and 5 are named the same law.",
)
assert laws[3] == laws[4]
assert broken.sum() < 0.25 * broken.size

# %% [markdown]
# ## All of them
#
# The table is made from the kit's own list, in which every mutant names its law; a test of the kit runs each pair. It
# shows one of each of the oracle's files. `python -m pop_ref.conformance.mutants` does the same on your machine, and
# with `--every` it finds all laws that notice a mutant, not only the one that is named. Where a mutant comes from is
# told by its `story`. The kit has more of them, copies of the program that trains:
# `pop_ref.conformance.mutants.PROGRAM`.

# %%
print(f"{len(MUTANTS)} mutants, {len(every_law())} laws; * was tried above\n")
of_files = {
    mutant.file: [other for other in MUTANTS if other.file == mutant.file] for mutant in MUTANTS
}
for mutant in (same[0] for same in of_files.values()):
    law = mutant.law.partition(":")[2].replace("_", " ")
    first = f"{'*' if mutant.name in tried else ' '} {mutant.name:38}"
    print(first + textwrap.shorten(law, 58, placeholder=" ..."))
assert {mutant.law for mutant in MUTANTS} <= set(every_law())

# %% [markdown]
# ### Exercise 1: code
#
# Write a mutant of your own: in `polarization.py` let every Gaussian be important, and find which laws of that stage
# notice.

# %% answer
mine = Mutant(
    name="all_important",
    story="the mask is true for Gaussians that dominate no pixel, too",
    file="polarization.py",
    old="return dominant_counts > 0",
    new="return dominant_counts >= 0",
    law="",
)
of_the_stage = {k: law for k, law in every_law().items() if law.stage == "polarization"}
with living(mine) as backend:
    notice = [k for k, law in of_the_stage.items() if obeys(law, backend, 25) is not None]
assert notice
assert len(notice) < len(of_the_stage)
print(*(name.partition(":")[2].replace("_", " ") for name in notice), sep="\n")

# %% [markdown]
# ### Exercise 2: code
#
# Write a law of your own that kills `half_pixel_shift`, as a function of a backend: a round splat in the middle of an
# image must look the same in a mirror. Does the law also kill `no_half_in_the_exponent`?


# %% answer
def mirrored(backend):
    screen = Camera(np.eye(4), K, WIDTH, HEIGHT)
    middle = Record(WIDTH / 2, HEIGHT / 2, 2.0, (3.0, 3.0, 3.0))
    image = backend.render(Scene(pack([middle], screen), screen)).image
    return np.allclose(image, image[:, ::-1], rtol=0, atol=1e-12)


assert mirrored(OracleAdapter())
with living(BY_NAME["half_pixel_shift"]) as backend:
    assert not mirrored(backend)
# a splat of the wrong width is symmetric, too: one law is never enough
with living(BY_NAME["no_half_in_the_exponent"]) as backend:
    assert mirrored(backend)

# %% [markdown]
# ### Exercise 3: predict
# Which of these mutants can be seen in *some* picture: a gradient that is wrong, a tie that goes to the back, an extent
# that is cut at three standard deviations?

# %% answer
# Only the last changes a picture: it cuts off what is visible between 3 and 3.33 standard deviations. Gradients are not
# drawn, and a tie changes which Gaussian dominates, not the colour.
screen = Camera(np.eye(4), K, WIDTH, HEIGHT)
# it ends shortly behind a tile's border, with three deviations shortly before it
one = Scene(pack([Record(6.0, 12.0, 2.0, (3.0, 3.0, 3.0), opacity=1.0)], screen), screen)
for name in ("weight_above_one", "tie_to_the_back", "extent_of_three_deviations"):
    with living(BY_NAME[name]) as backend:
        differs = np.abs(backend.render(one).image - OracleAdapter().render(one).image).max()
    print(f"{name:28} {differs:.4f}")
    assert (differs > 0) == (name == "extent_of_three_deviations")

# %% [markdown]
# ### Exercise 4: derive
# Two splats get depths that are drawn at random from $n$ values. How large is the chance that they tie? Why does the
# kit not draw depths uniformly from an interval?

# %% answer
# $1/n$. For an interval of float64 numbers $n$ is about $2^{52}$: a law that speaks of ties would never see one. So the
# kit draws from few round numbers on purpose, and aims at thresholds.
draws = np.random.default_rng(0).integers(0, 8, (20_000, 2))
print(np.mean(draws[:, 0] == draws[:, 1]))
assert np.isclose(np.mean(draws[:, 0] == draws[:, 1]), 1 / 8, atol=0.01)

# %% [markdown]
# ### Exercise 5: find the bug
# The mutant of exercise 3, as it stands in the code.
#
# {{bug: extent_of_three_deviations}}

# %% answer
# 3 in place of the profile's 3.33: the first program of 3DGS does so and cuts alphas of up to 0.011 off, three steps of
# an 8-bit picture. Later ones reach as far as alpha is over the floor.
print(caught("extent_of_three_deviations"))
