"""The oracle as a program that answers the kit's protocol: what crosses the pipe must cost no bit.

Words after the script's name break it: `losses`, `density`, `cameras` and `depth` each bring one error in, `quats` and
`centres` leave a gradient out and add one. `bands` refuses harmonics beyond the first degree, and says so.
"""

import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from typing import Any, get_args, get_type_hints

import numpy as np

from pop_ref.conformance.adapter import STAGE_MODULES, stage_function
from pop_ref.conformance.program_values import DRAW, NONE, decoded, encoded, line_of, shape_of, signature_of
from pop_ref.constants import Profile
from pop_ref.records import Camera, Gaussians
from pop_ref.render import render, render_vjp
from pop_ref.splatting import project

BROKEN = sys.argv[1:]
LEAVES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")
ARRAYS = (*LEAVES, "Ks")


def read_array(shape: tuple[int, ...]) -> np.ndarray:
    data = sys.stdin.buffer.read(8 * math.prod(shape))
    return np.frombuffer(data, "<f8").reshape(shape).copy()


def write(line: str, arrays: list[np.ndarray]) -> None:
    body = b"".join(np.ascontiguousarray(each, "<f8").tobytes() for each in arrays)
    sys.stdout.buffer.write(line.encode() + b"\n" + body)
    sys.stdout.buffer.flush()


def draw(number: int) -> np.ndarray:
    write(f"draw {number}", [])
    return read_array(shape_of(sys.stdin.buffer.readline().decode().strip().partition("=")[2]))


def given_by(words: list[str]) -> dict[str, Any]:
    pairs = [word.partition("=")[::2] for word in words]
    return {key: read_array(shape_of(value)) if value.startswith("[") else value for key, value in pairs}


def argument(kind: Any, given: dict[str, Any], name: str) -> Any:
    if isinstance(given.get(name), str) and given[name] == DRAW:
        return draw
    parts = get_args(kind) if "|" in str(kind) and "Mapping" in str(kind) else (kind,)
    # a number, or one for each parameter
    return decoded(parts[0] if name in given else parts[-1], given, name)


def stage(name: str, given: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    found, function = signature_of(name), stage_function("pop_ref", name)
    assert found is not None
    assert function is not None
    hints = get_type_hints(function)
    value = function(**{key: argument(hints[key], given, key) for key in found[0].parameters})
    if "losses" in BROKEN and name == "l2":
        value *= 0.5
    if "density" in BROKEN and name == "grow_masks":
        value = value[::-1]
    return encoded(value, "value")


def frames(given: dict[str, Any]) -> Iterator[tuple[tuple[int, int], dict[str, Any]]]:
    """Yield batch entry and camera, and what the oracle takes for them; a single entry has a batch of one."""
    if "covars" in given:
        raise NotImplementedError("covariances are not supported")
    batch = given["viewmats"].shape[:-3]
    B, C = math.prod(batch), given["viewmats"].shape[-3]
    profile = decoded(Profile, given, "profile")
    degree = None if given["sh_degree"] == NONE else int(given["sh_degree"])
    if "bands" in BROKEN and (degree or 0) > 1:
        raise NotImplementedError("harmonics beyond the first degree are not supported")
    of = {name: value.reshape(B, *value.shape[len(batch) :]) for name, value in given.items() if name in ARRAYS}
    for b, c in np.ndindex(B, C):
        # colours of N Gaussians: channels, or coefficients and channels; before them may stand a camera's
        own = of["colors"].ndim == (4 if degree is None else 5)
        colors = of["colors"][b, c] if own else of["colors"][b]
        sh = np.zeros((len(colors), 1, 3)) if degree is None else colors
        seen = "cameras" not in BROKEN or c < 2
        camera = Camera(of["viewmats"][b, c], of["Ks"][b, c if seen else 0], int(given["width"]), int(given["height"]))
        gaussians = Gaussians(of["means"][b], of["quats"][b], of["scales"][b], of["opacities"][b], sh)
        yield (
            (b, c),
            {
                "gaussians": clipped(gaussians, camera, degree, profile, given),
                "camera": camera,
                "background": of["backgrounds"][b, c]
                if "backgrounds" in of and given["render_mode"] not in ("D", "ED")
                else None,
                "sh_degree": degree,
                "profile": profile,
                "tile_size": int(given["tile_size"]),
                "antialiased": given["rasterize_mode"] == "antialiased",
                "colors": colors if degree is None else None,
                "render_mode": given["render_mode"],
            },
        )


def clipped(g: Gaussians, camera: Camera, degree: int | None, profile: Profile, given: dict[str, Any]) -> Gaussians:
    """Make the Gaussians invisible that radius_clip culls."""
    radii = project(g, camera, degree, profile, given["rasterize_mode"] == "antialiased").radii
    small = np.all(radii <= float(given["radius_clip"]), axis=1) & (float(given["radius_clip"]) > 0.0)
    return replace(g, opacities=np.where(small, 0.0, g.opacities))


def rasterization(given: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    images, alphas = {}, {}
    for at, options in frames(given):
        drawn = render(**options)
        depth = drawn.image[..., -1:] * (1.125 if "depth" in BROKEN and "D" in given["render_mode"] else 1.0)
        images[at], alphas[at] = np.concatenate((drawn.image[..., :-1], depth), axis=2), 1.0 - drawn.T_final
    yield "images", np.array(list(images.values()))
    yield "alphas", np.array(list(alphas.values()))


def rasterization_vjp(given: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    v = {name: np.zeros_like(given[name]) for name in LEAVES if name in given}
    batch = given["viewmats"].shape[:-3]
    whole = {name: value.reshape(math.prod(batch), *value.shape[len(batch) :]) for name, value in v.items()}
    v_images, v_alphas = (
        given[name].reshape(-1, given["viewmats"].shape[-3], *given[name].shape[len(batch) + 1 :])
        for name in ("v_images", "v_alphas")
    )
    for (b, c), options in frames(given):
        g = render_vjp(**options, v_image=v_images[b, c], v_T_final=-v_alphas[b, c])
        for name in ("means", "quats", "scales", "opacities"):
            whole[name][b] += getattr(g, name)
        v_colors = g.sh if g.colors is None else g.colors
        own = whole["colors"].ndim == v_colors.ndim + 2
        whole["colors"][(b, c) if own else b] += v_colors
        whole["viewmats"][b, c] = g.viewmat
        if options["background"] is not None:
            whole["backgrounds"][b, c] = g.background
    if "centres" in BROKEN:
        v["means2d"] = v["means"]
    yield from ((f"v_{name}", value) for name, value in v.items() if name not in BROKEN)


def offered() -> str:
    names = {name for module in STAGE_MODULES for name in vars(import_module(f"pop_ref.{module}"))}
    known = sorted(name for name in names if signature_of(name) is not None)
    return ",".join(("rasterization", "rasterization_vjp", *known))


def main() -> None:
    while line := sys.stdin.buffer.readline().decode():
        verb, *words = line.split()
        if verb == "hello":
            bands = " sh_degree=1" * ("bands" in BROKEN)
            write(f"ok name=oracle dtype=float64 profile=any{bands} offers={offered()}", [])
            continue
        name, given = words[0], given_by(words[1:])
        try:
            function = globals()[name](given) if name in ("rasterization", "rasterization_vjp") else stage(name, given)
            answer = list(function)
        except NotImplementedError as error:
            write(f"error {error}", [])
            continue
        numbers = [(key, np.asarray(value, dtype=np.float64)) for key, value in answer]
        write(f"ok {line_of(numbers)}", [value for _, value in numbers])


main()
