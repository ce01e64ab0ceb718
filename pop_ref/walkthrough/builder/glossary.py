"""The words, symbols, labels and stages of the method in tables, made from the notation and the constants."""

from __future__ import annotations

from typing import Final, NamedTuple

from pop_ref.constants import DECISIONS, KINKS
from pop_ref.notation import AXES, SYMBOLS, symbol_named

GLOSSARY_PAGE: Final = "glossary.html"


class Term(NamedTuple):
    """A word, the chapter that defines it where it first uses it, and what it means."""

    word: str
    chapter: str
    meaning: str


class Stage(NamedTuple):
    """A stage of the method: its module, what it takes and gives by the names of the notation, where it is taught."""

    title: str
    module: str
    takes: tuple[str, ...]
    gives: tuple[str, ...]
    chapter: str


TERMS: Final = (
    Term("Gaussian", "0", "a soft ellipsoid in space: a centre, a covariance, an opacity and a colour"),
    Term("splat", "0", "what a Gaussian becomes on the screen: a soft ellipse"),
    Term("training", "0", "changing the Gaussians step by step until their pictures look like the photographs"),
    Term("oracle", "0", "`pop_ref`: the method in plain NumPy, to which everything faster is compared"),
    Term("covariance", "1", "a symmetric matrix that says how wide a Gaussian is, and in which directions"),
    Term("opacity", "1", "how much a Gaussian hides at its centre, between 0 and 1"),
    Term("alpha", "1", "how much a splat hides at one pixel: its opacity times its falloff there"),
    Term("conic", "1", "the inverse of a covariance on the screen, as its three different entries"),
    Term("floor", "1", "an alpha under 1/255 is skipped"),
    Term("ceiling", "1", "an alpha is cut at 0.999"),
    Term("raw parameter", "1b", "the number that training changes; scales, opacities and rotations are made from it"),
    Term("logit", "1b", "ln(o / (1 - o)), the raw parameter of an opacity o"),
    Term("quaternion", "1b", "four numbers for a rotation"),
    Term("learning rate", "1b", "how long a step of training is"),
    Term("Adam", "1b", "gradient descent with steps that do not depend on the size of the gradient"),
    Term("cotangent", "1b", "the gradient of the loss with respect to something, written `v_` and its name"),
    Term("vjp", "1b", "vector-Jacobian product: takes the cotangent of a function's result to that of its input"),
    Term("Jacobian", "1b", "the matrix of a function's first derivatives"),
    Term("density control", "5", "the rules that add and remove Gaussians in training"),
    Term("near plane", "2", "the depth in front of which nothing is drawn"),
    Term("spherical harmonics", "3", "fixed polynomials of a direction, of which a colour is a sum"),
    Term("gamma", "3", "the exponent by which a photograph's file encodes light; no stage here decodes it"),
    Term("transmittance", "4", "the share of light that passes all splats in front"),
    Term("weight", "4", "what a splat contributes to a pixel: transmittance times alpha"),
    Term("early ray termination", "4", "a pixel ends when next to no light is left"),
    Term("tile", "4b", "a square of 16 x 16 pixels that share one list of splats"),
    Term("key", "4b", "a whole number by which splats are sorted: tile first, then depth"),
    Term("prior", "6", "a term of the loss that does not look at the photographs"),
    Term("SSIM", "6", "a measure of likeness that compares windows of pixels, 1 for equal pictures"),
    Term("PSNR", "6", "minus ten times the decimal logarithm of the mean squared error, in decibels (dB)"),
    Term("dominant", "4", "of all splats at a pixel, the one with the largest weight"),
    Term("gradient leakage", "8", "hidden or faint Gaussians still receive gradients and stay alive"),
    Term("clone", "9", "a copy of a small Gaussian that is pulled hard"),
    Term("split", "7", "two smaller Gaussians in place of a large one that is pulled hard"),
    Term("prune", "9", "to remove Gaussians that are all but transparent"),
    Term("capture", "9b", "photographs of a scene, where each was taken, and a sparse cloud of points"),
    Term("mutant", "12", "a copy of the oracle with one line broken"),
    Term("law", "12", "a sentence that must hold for every input of a correct renderer"),
)

STAGES: Final = (
    Stage("activate", "activations", ("log_scales", "logit_opacities"), ("scales", "opacities"), "1b"),
    Stage("covariances", "covariance", ("quats", "scales"), ("covars",), "2"),
    Stage("into the camera", "camera", ("means", "covars", "viewmat"), ("means_cam", "covars_cam", "depths"), "2"),
    Stage("project", "projection", ("means_cam", "covars_cam", "K"), ("means2d", "covars2d"), "2"),
    Stage("footprint", "footprint", ("covars2d", "opacities"), ("conics", "radii"), "2"),
    Stage("colour", "harmonics", ("sh", "dirs"), ("colors",), "3"),
    Stage("tiles and order", "tiles", ("means2d", "radii", "depths"), ("tile_lists",), "4b"),
    Stage("blend", "compositing", ("conics", "colors", "tile_lists"), ("image", "T_final"), "4"),
    Stage("dominance", "dominance", ("weight",), ("dominant_ids", "dominant_counts"), "7"),
    Stage("loss and prior", "losses", ("image", "dominant_counts"), ("v_x",), "6"),
    Stage("Adam", "optimizer", ("v_x",), ("log_scales", "logit_opacities"), "1b"),
    Stage("clone, split, prune", "density", ("v_x", "dominant_counts"), ("means",), "9"),
)


def shapes(names: tuple[str, ...]) -> str:
    """Write names with the shapes that the notation gives them.

    Raises:
        ValueError: the notation has no such symbol.
    """
    return ", ".join("gradients" if name == "v_x" else f"{name} {symbol_named(name).shape}".rstrip() for name in names)


def glossary() -> str:
    """Write the words, the labels and the symbols as markdown tables."""
    words = [f"| {term.word} | {term.meaning} | {term.chapter} |" for term in TERMS]
    labels = [f"| {label} | {meaning} |" for label, meaning in (DECISIONS | KINKS).items()]
    symbols = [
        f"| `{s.name}` | {s.shape} | {s.unit} | {s.frame} | {f'${s.paper}$' if s.paper else ''} | {s.meaning} |"
        for s in SYMBOLS
    ]
    axes = ", ".join(f"{letter} {meaning}" for letter, meaning in AXES.items())
    return "\n".join(
        [
            "## Words\n\n| word | meaning | chapter |\n|---|---|---|",
            *words,
            "\n## Labels\n\nD are decisions, where an image jumps; B are kinks, where a gradient does.\n",
            "| label | meaning |\n|---|---|",
            *labels,
            f"\n## Symbols\n\nIn code a plural is an axis. {axes}.\n",
            "| in code | shape | unit | frame | in the paper | meaning |\n|---|---|---|---|---|---|",
            *symbols,
        ]
    )


def stages() -> str:
    """Write the stages as a markdown table, with the shapes of what they take and give."""
    rows = [
        f"| {s.title} | `pop_ref/{s.module}.py` | {shapes(s.takes)} | {shapes(s.gives)} | {s.chapter} |" for s in STAGES
    ]
    return "\n".join(["| stage | module | takes | gives | chapter |\n|---|---|---|---|---|", *rows])
