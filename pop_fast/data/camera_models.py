"""The camera models of photographs: their names in every format, their parameters, and how each bends a picture.

A photograph of any model becomes one of a pinhole camera (`pop_fast.data.read_images`), for which it is enough to know
where the model shows a ray: at u = fx x' + cx, v = fy y' + cy, where (x', y') is `distort(x, y, ...)` of the ray (x, y,
1). Models of which this table has no `distort`, and COLMAP's models that it does not list, are pycolmap's.

Another package declares a `CameraModel` under the entry point group `pop_splatting.camera_models`, or calls
`CAMERA_MODELS.register`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from pop_fast.errors import CaptureError
from pop_ref.registry import Registry

# a list of cameras whose fields name terms, and what it calls the model there
Place = tuple[str, str]


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A camera model.

    Attributes:
        name: COLMAP's, of a model that COLMAP has.
        params: names of its parameters in order. The focal lengths in px are `fx` and `fy`, or `f` for both, the
            principal point is `cx`, `cy`; what follows are its terms.
        number: COLMAP's, in binary files; None of a model that COLMAP does not have.
        distort: gives (x', y') of arrays x, y and the terms in order; None where pycolmap projects.
        fields: where other formats have it, by format and by what each calls the model: its terms with the names of
            their fields there. A term that is left out is 0. Formats are `transforms`, `metashape`, `realitycapture`.
        refusal: why no photograph of it can be used, and the fix; continues "is <name>, ".
    """

    name: str
    params: tuple[str, ...]
    number: int | None = None
    distort: Callable[..., tuple[Any, Any]] | None = None
    fields: Mapping[Place, Mapping[str, str]] = field(default_factory=dict)
    refusal: str | None = None

    @property
    def terms(self) -> tuple[str, ...]:
        """What follows the focal lengths and the principal point."""
        return tuple(name for name in self.params if name not in ("f", "fx", "fy", "cx", "cy"))


def _straight(x: Any, y: Any) -> tuple[Any, Any]:
    return x, y


def _brown4(x: Any, y: Any, k1: float, k2: float, k3: float, k4: float, p1: float, p2: float) -> tuple[Any, Any]:
    """Bend by Brown's polynomial: x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + 2 p1 x y + p2 (r^2 + 2 x^2)."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    mixed = 2.0 * x * y
    return x * radial + p1 * mixed + p2 * (r2 + 2.0 * x * x), y * radial + p2 * mixed + p1 * (r2 + 2.0 * y * y)


def _same(*names: str) -> dict[str, str]:
    return {name: name for name in names}


_PINHOLE: Final = ("fx", "fy", "cx", "cy")
_FRAME, _FISHEYE, _REALITYCAPTURE = ("metashape", "frame"), ("metashape", "fisheye"), ("realitycapture", "Brown")
# what transforms.json calls a lens with Brown's terms, or the name that says nothing
_PERSPECTIVE: Final = tuple(("transforms", name) for name in ("OPENCV", "SIMPLE_RADIAL", "RADIAL"))
# Metashape counts its tangential terms the other way round
_SWAPPED: Final = {"p1": "p2", "p2": "p1"}
_T1_T2: Final = {"p1": "t1", "p2": "t2"}
_K123: Final = _same("k1", "k2", "k3")
_ARIA: Final = ("k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3")

_MODELS: Final = (
    CameraModel("SIMPLE_PINHOLE", ("f", "cx", "cy"), 0, _straight),
    CameraModel(
        "PINHOLE",
        _PINHOLE,
        1,
        _straight,
        {
            **{place: {} for place in (*_PERSPECTIVE, _FRAME, _REALITYCAPTURE)},
            **{("transforms", name): {} for name in ("PINHOLE", "SIMPLE_PINHOLE", "perspective")},
        },
    ),
    CameraModel(
        "OPENCV",
        (*_PINHOLE, "k1", "k2", "p1", "p2"),
        4,
        fields={
            **{place: _same("k1", "k2", "p1", "p2") for place in _PERSPECTIVE},
            _FRAME: {**_same("k1", "k2"), **_SWAPPED},
            _REALITYCAPTURE: {**_same("k1", "k2"), **_T1_T2},
        },
    ),
    # k4 to k6 are in the denominator
    CameraModel(
        "FULL_OPENCV",
        (*_PINHOLE, "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
        6,
        fields={
            **{
                place: _same("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
                for place in (*_PERSPECTIVE, ("transforms", "FULL_OPENCV"))
            },
            _FRAME: {**_K123, **_SWAPPED},
            _REALITYCAPTURE: {**_K123, **_T1_T2},
        },
    ),
    CameraModel(
        "BROWN4",
        (*_PINHOLE, "k1", "k2", "k3", "k4", "p1", "p2"),
        distort=_brown4,
        fields={
            ("transforms", "BROWN4"): _same("k1", "k2", "k3", "k4", "p1", "p2"),
            _FRAME: {**_K123, "k4": "k4", **_SWAPPED},
            _REALITYCAPTURE: {**_K123, "k4": "k4", **_T1_T2},
        },
    ),
    CameraModel(
        "OPENCV_FISHEYE",
        (*_PINHOLE, "k1", "k2", "k3", "k4"),
        5,
        fields={place: {**_K123, "k4": "k4"} for place in (("transforms", "OPENCV_FISHEYE"), _FISHEYE)},
    ),
    CameraModel(
        "THIN_PRISM_FISHEYE",
        (*_PINHOLE, "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
        10,
        fields={
            ("transforms", "THIN_PRISM_FISHEYE"): _same("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
            _FISHEYE: {**_K123, "k4": "k4", **_SWAPPED},
        },
    ),
    # nerfstudio's name is that of Project Aria's glasses
    CameraModel(
        "RAD_TAN_THIN_PRISM_FISHEYE",
        (*_PINHOLE, *_ARIA),
        11,
        fields={("transforms", "FISHEYE624"): {name: f"distortion_params[{i}]" for i, name in enumerate(_ARIA)}},
    ),
    CameraModel(
        "EQUIRECTANGULAR",
        ("w", "h"),
        17,
        fields={("transforms", "EQUIRECTANGULAR"): {}},
        refusal="a full sphere that no pinhole image can hold; cut it into perspective views",
    ),
)
# of several models that a format has under one name, the first that has all terms which a file gives is taken
CAMERA_MODELS: Final[Registry[CameraModel]] = Registry(
    "camera model",
    "pop_splatting.camera_models",
    {model.name: model for model in _MODELS},
    needs=("name", "params", "terms", "number", "distort", "fields", "refusal"),
    error=CaptureError,
)
# fields of terms that no model here has, which a file may give as 0
UNKNOWN_TERMS: Final = {
    "transforms": ("s1", "s2", "s3", "s4", "tauX", "tauY"),
    "metashape": ("p3", "p4"),
    "realitycapture": (),
}


def models_of(program: str) -> dict[str, list[CameraModel]]:
    """Return the models that a format has, by what it calls them, in the order in which they are tried."""
    found: dict[str, list[CameraModel]] = {}
    for _, model in CAMERA_MODELS.usable():
        for of, kind in model.fields:
            if of == program:
                found.setdefault(kind, []).append(model)
    return found


def fields_of(program: str) -> tuple[str, ...]:
    """Return the names of all fields that are terms of some model in a format."""
    places = [(place, names) for _, model in CAMERA_MODELS.usable() for place, names in model.fields.items()]
    named = [name for (of, _), names in places if of == program for name in names.values()]
    return (*dict.fromkeys(named), *UNKNOWN_TERMS[program])


def known_model(name: str) -> CameraModel | None:
    """Return a model of the table by its name; None of one that is only COLMAP's."""
    return CAMERA_MODELS.named(name) if name in CAMERA_MODELS else None
