"""The file formats of splats: names, what each keeps and loses, and the functions that write and read it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from pop_fast.io.formats import compressed_ply, dot_splat, gltf, sog, spz
from pop_fast.io.formats.cloud import Cloud, morton_order


@dataclass(frozen=True)
class Format:
    """A file format.

    Attributes:
        name: as `--to` takes it.
        suffix: of its files.
        title: what people call it.
        source: where it is described.
        size: bytes a Gaussian before general compression, without and with colours of degree 3.
        losses: by field, what a round trip changes.
        readers: programs that open it.
        encode: makes a file's bytes of Gaussians in the file's order.
        decode: reads them; the path is for errors.
        order: of the Gaussians in the file; None keeps theirs.
        mark: what a file's name has before the suffix if it is not given, so that no two formats share a name.
        has_frame: whether it has room for the world that the splat is in.
        coarser: encoders that spend ever fewer bytes on view dependence, for files that have to be small.
    """

    name: str
    suffix: str
    title: str
    source: str
    size: tuple[str, str]
    losses: Mapping[str, str]
    readers: str
    encode: Callable[[Cloud], bytes]
    decode: Callable[[bytes, Path], Cloud]
    order: Callable[[Cloud], np.ndarray] | None = None
    mark: str = ""
    has_frame: bool = True
    coarser: tuple[Callable[[Cloud], bytes], ...] = ()

    @property
    def encoders(self) -> tuple[Callable[[Cloud], bytes], ...]:
        """All encoders, the usual one first."""
        return self.encode, *self.coarser


def _by_place(cloud: Cloud) -> np.ndarray:
    return morton_order(cloud.means)


# steps of the coefficients of SPZ, in 1/128, and Gaussians for a row of SOG's palette; see `Format.coarser`
_SH_STEPS: Final = (4.0, 8.0, 12.0, 18.0, 27.0)
_SHARED_BY: Final = (4, 8, 16, 32, 64)


_BYTE_OPACITY: Final = "half of 1/255"
_SPZ_LOSSES: Final = {
    "centre": "half of 2^-b units, or 1/16 of its smallest scale where that is more; b is the largest up to 20 that "
    "the farthest centre leaves",
    "scale": "factor within 3.2 %, between 4.5e-5 and 380 units",
    "rotation": "0.28° (10 bits a component)",
    "opacity": _BYTE_OPACITY,
    "colour": "half of 1/136 (degree 0), cut off at -0.44 and 1.44",
    "view dependence": "coefficients in [-1, 1], within 1/75 of a Gaussian that is well seen, coarser the less it is, "
    "down to 1/4",
}

COMPRESSED_PLY: Final = Format(
    name="compressed-ply",
    suffix=".compressed.ply",
    title="PlayCanvas compressed PLY",
    source="https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply",
    size=("16.3", "61.3"),
    losses={
        "centre": "half of 1/2047 (y: 1/1023) of its chunk's extent",
        "scale": "logarithm within half of 1/2047 (y: 1/1023) of its chunk's range, in [-20, 20]",
        "rotation": "0.28° (10 bits a component)",
        "opacity": _BYTE_OPACITY,
        "colour": "half of 1/255 of its chunk's range (degree 0)",
        "view dependence": "coefficients in [-4, 4], within 1/64; none is 0",
    },
    readers="SuperSplat, PlayCanvas, Spark, GaussianSplats3D",
    encode=compressed_ply.encode,
    decode=compressed_ply.decode,
    order=compressed_ply.chunked,
)
SPZ: Final = Format(
    name="spz",
    suffix=".spz",
    title="Niantic SPZ, version 3",
    source="https://github.com/nianticlabs/spz",
    size=("20, then gzip", "65, then gzip"),
    losses=_SPZ_LOSSES,
    readers="Scaniverse, SuperSplat, Babylon.js, Spark, Cesium",
    encode=spz.encode,
    decode=spz.decode,
    order=_by_place,
    coarser=tuple(partial(spz.encode, sh_step=step) for step in _SH_STEPS),
)
SPZ_4: Final = replace(
    SPZ,
    name="spz-4",
    title="Niantic SPZ, version 4",
    size=("20, then Zstandard", "65, then Zstandard"),
    readers="Niantic's own programs, PlayCanvas's splat-transform",
    encode=partial(spz.encode, version=4),
    mark="-4",
    coarser=tuple(partial(spz.encode, version=4, sh_step=step) for step in _SH_STEPS),
)
SOG: Final = Format(
    name="sog",
    suffix=".sog",
    title="PlayCanvas SOG, version 2",
    source="https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog",
    size=("17, then WebP", "19 and a palette, then WebP"),
    losses={
        "centre": "half of 1/65535 of the scene's extent in sign(x) log(1 + abs(x))",
        "scale": "nearest of 256 numbers that are fitted to the splat, to what is large and opaque the most",
        "rotation": "1.1° (8 bits a component)",
        "opacity": _BYTE_OPACITY,
        "colour": "nearest of 256 numbers that are fitted to the splat (degree 0); lost where the opacity is 0",
        "view dependence": "nearest row of a fitted palette, one for two Gaussians, at most 65,536",
    },
    readers="SuperSplat, PlayCanvas, Babylon.js, Spark",
    encode=sog.encode,
    decode=sog.decode,
    order=_by_place,
    coarser=tuple(partial(sog.encode, shared_by=each) for each in _SHARED_BY),
)
SPLAT: Final = Format(
    name="splat",
    suffix=".splat",
    title="antimatter15 .splat",
    source="https://github.com/antimatter15/splat",
    size=("32", "32"),
    losses={
        "centre": "none",
        "scale": "rounding to float32",
        "rotation": "1.2° (8 bits a component)",
        "opacity": _BYTE_OPACITY,
        "colour": "half of 1/255 (degree 0), cut off at 0 and 1",
        "view dependence": "all of it",
    },
    readers="antimatter15/splat, SuperSplat, Babylon.js, Spark, viser",
    encode=dot_splat.encode_splat,
    decode=dot_splat.decode_splat,
    order=dot_splat.largest_first,
    has_frame=False,
)
GLTF: Final = Format(
    name="gltf",
    suffix=".glb",
    title="glTF with KHR_gaussian_splatting",
    source=f"https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/{gltf.NAME}",
    size=("60", "240"),
    losses={
        "centre": "none",
        "scale": "rounding to float32",
        "rotation": "none",
        "opacity": "rounding to float32, at most 1 - 2^-24",
        "colour": "none",
        "view dependence": "none",
    },
    readers="Babylon.js, PlayCanvas, Cesium; others show points",
    encode=gltf.encode,
    decode=gltf.decode,
)
GLTF_SPZ: Final = replace(
    GLTF,
    name="gltf-spz",
    title=f"glTF with {gltf.SPZ_NAME} (a draft)",
    source=f"https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/{gltf.SPZ_NAME}",
    size=("19, then gzip", "64, then gzip"),
    losses={**_SPZ_LOSSES, "rotation": "2.6° (xyz as bytes), up to 14° within 72° of a half turn"},
    readers="Cesium",
    encode=gltf.encode_spz,
    order=_by_place,
    mark="-spz",
    coarser=tuple(partial(gltf.encode_spz, sh_step=step) for step in _SH_STEPS),
)

# what is read and not written, by suffix
READ_ONLY: Final[Mapping[str, Callable[[bytes, Path], Cloud]]] = {".ksplat": dot_splat.decode_ksplat}
