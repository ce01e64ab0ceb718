"""glTF 2.0 with KHR_gaussian_splatting, as .glb: float32 attributes, or an SPZ stream in their place.

Attributes of a POINTS primitive: POSITION, COLOR_0 (for programs without the extension), and under the extension's name
ROTATION (xyzw), SCALE (activated), OPACITY (activated) and SH_DEGREE_d_COEF_n. The frame has y up and z forward: half a
turn about z from that of PLY. With KHR_gaussian_splatting_compression_spz_2, a draft, the values come from an SPZ file
of version 2 in a buffer view, and the accessors only state their types.

Source: https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_fast.errors import PopError
from pop_fast.io.formats import spz
from pop_fast.io.formats.cloud import COEFFICIENTS, SH_C0, Cloud, to_bytes
from pop_fast.io.ply import KEY, Frame
from pop_fast.io.read_back import WRITE_AGAIN

NAME: Final = "KHR_gaussian_splatting"
SPZ_NAME: Final = "KHR_gaussian_splatting_compression_spz_2"
_MAGIC: Final = b"glTF"
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_FLOAT, _BYTE = 5126, 5121
_TYPES: Final = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
# what a splat's extension may say here, which is also taken where it says nothing
_KNOWN: Final = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
_TRANSFORMS: Final = frozenset({"matrix", "rotation", "scale", "translation"})
# an opacity of 1 has no finite logit; the largest float32 under it has
_OPAQUE: Final = 1.0 - 2.0**-24


def encode(cloud: Cloud) -> bytes:
    """Write .glb with float32 attributes; the order of the Gaussians is kept."""
    return _glb(cloud.turned("z"), None)


def encode_spz(cloud: Cloud, sh_step: float = spz.SH_STEP) -> bytes:
    """Write .glb with an SPZ stream, as `spz.encode` does; the order of the Gaussians is kept."""
    return _glb(cloud.turned("z"), spz.encode(replace(cloud, frame=None), version=2, sh_step=sh_step))


def _attributes(turned: Cloud) -> dict[str, np.ndarray]:
    """Make the attributes of a cloud in glTF's frame, by name."""
    opacities = turned.opacities
    rgb = 0.5 + SH_C0 * turned.sh0.astype(np.float64)
    arrays = {
        "POSITION": turned.means,
        f"{NAME}:ROTATION": turned.quats[:, [1, 2, 3, 0]],
        f"{NAME}:SCALE": turned.scales,
        f"{NAME}:OPACITY": opacities[:, None],
        f"{NAME}:SH_DEGREE_0_COEF_0": turned.sh0,
    }
    names = (f"{NAME}:SH_DEGREE_{d}_COEF_{i}" for d in range(1, turned.degree + 1) for i in range(2 * d + 1))
    arrays |= {name: turned.rest[:, k] for k, name in enumerate(names)}
    found = {name: np.ascontiguousarray(array, "<f4") for name, array in arrays.items()}
    return {**found, "COLOR_0": to_bytes(255.0 * np.concatenate([rgb, opacities[:, None]], axis=1))}


def _glb(turned: Cloud, stream: bytes | None) -> bytes:
    """Lay out a .glb file: with the attributes' bytes, or with a stream that holds their values."""
    attributes = _attributes(turned)
    views: list[dict[str, int]] = []
    body = bytearray()

    def view(part: bytes) -> int:
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(part)})
        body.extend(part + bytes(-len(part) % 4))
        return len(views) - 1

    accessors: list[dict[str, Any]] = []
    extension: dict[str, Any] = dict(_KNOWN)
    used = [NAME]
    if stream is not None:
        extension["extensions"] = {SPZ_NAME: {"bufferView": view(stream)}}
        used.append(SPZ_NAME)
    for name, array in attributes.items():
        kind = {"componentType": _BYTE, "normalized": True} if array.dtype == np.uint8 else {"componentType": _FLOAT}
        accessor = {**kind, "count": len(turned), "type": _TYPES[array.shape[1]]}
        if name == "POSITION" and len(turned):
            accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        # a buffer view may not be empty
        stored = stream is None and array.size
        accessors.append({"bufferView": view(array.tobytes()), **accessor} if stored else accessor)
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "mode": 0,
        "extensions": {NAME: extension},
    }
    # what glTF has no place for
    extras = {"antialiased": turned.antialiased, **({} if turned.frame is None else {KEY: turned.frame.entry()})}
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "pop-splatting", "extras": extras},
        "extensionsUsed": used,
        **({} if stream is None else {"extensionsRequired": used}),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        **({"bufferViews": views, "buffers": [{"byteLength": len(body)}]} if views else {}),
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), _JSON) + text
    if views:
        chunks += struct.pack("<II", len(body), _BIN) + bytes(body)
    return _MAGIC + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def decode(data: bytes, path: Path) -> Cloud:
    """Read the splat of a .glb file, with float32 attributes or an SPZ stream."""
    content, body = _chunks(data, path)
    try:
        primitive = _splat(content, path)
        inner = primitive["extensions"][NAME].get("extensions", {})
        if SPZ_NAME in inner:
            cloud = spz.decode(_part(content, body, inner[SPZ_NAME]["bufferView"], path), path)
        else:
            cloud = _from_attributes(content, body, primitive["attributes"], path)
        frame = Frame.of_entry(content.get("asset", {}).get("extras"), path)
        return cloud if frame is None else replace(cloud, frame=frame)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        if isinstance(error, PopError):
            raise
        raise PopError(f"{path}: its JSON does not follow glTF 2.0 ({error!r}); {WRITE_AGAIN}") from error


def _chunks(data: bytes, path: Path) -> tuple[dict[str, Any], bytes]:
    """Return the JSON and the binary chunk."""
    if len(data) < 20 or data[:4] != _MAGIC:
        raise PopError(f"{path}: does not begin as a .glb file; where it is .gltf, pack it into .glb")
    version, total, length, kind = struct.unpack("<IIII", data[4:20])
    if version != 2 or kind != _JSON or total > len(data) or 20 + length > total:
        raise PopError(f"{path}: its chunks do not fit into {len(data)} bytes; {WRITE_AGAIN}")
    try:
        content = json.loads(data[20 : 20 + length])
    except (ValueError, RecursionError) as error:
        raise PopError(f"{path}: its JSON is damaged ({error}); {WRITE_AGAIN}") from error
    at = 20 + length
    if at + 8 > total:
        return content, b""
    length, kind = struct.unpack("<II", data[at : at + 8])
    if kind != _BIN or at + 8 + length > total:
        raise PopError(f"{path}: its binary chunk of {length} bytes does not fit; {WRITE_AGAIN}")
    return content, data[at + 8 : at + 8 + length]


def _splat(content: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Return the primitive that is the splat, whose numbers mean what they do in a PLY but for the frame."""
    found = [
        (index, primitive)
        for index, mesh in enumerate(content.get("meshes", []))
        for primitive in mesh["primitives"]
        if NAME in primitive.get("extensions", {})
    ]
    if not found:
        raise PopError(f"{path}: holds no splat: no primitive has the extension {NAME}")
    if len(found) > 1:
        raise PopError(f"{path}: holds {len(found)} splats; write each as a file of its own")
    index, primitive = found[0]
    for name, known in _KNOWN.items():
        value = primitive["extensions"][NAME].get(name, known)
        if value != known:
            raise PopError(f"{path}: its splat has the {name} {value!r}; only {known!r} is known here")
    if _moved(content.get("nodes", []), index):
        raise PopError(f"{path}: a node moves its splat; apply the node's transform to the splat first")
    return primitive


def _moved(nodes: Sequence[Mapping[str, Any]], mesh: int) -> bool:
    """Tell whether a node that shows a mesh, or one above it, has a transform."""
    parents = {child: index for index, node in enumerate(nodes) for child in node.get("children", ())}
    seen = set[int]()
    for index, node in enumerate(nodes):
        at = index if node.get("mesh") == mesh else None
        while at is not None and at not in seen:
            if _TRANSFORMS & set(nodes[at]):
                return True
            seen.add(at)
            at = parents.get(at)
    return False


def _from_attributes(content: Mapping[str, Any], body: bytes, attributes: Mapping[str, int], path: Path) -> Cloud:
    def attribute(name: str, width: int) -> np.ndarray:
        if name not in attributes:
            raise PopError(f"{path}: its splat has no attribute {name}; {WRITE_AGAIN}")
        accessor = content["accessors"][attributes[name]]
        n = accessor["count"]
        if accessor["componentType"] != _FLOAT or accessor["type"] != _TYPES[width] or "sparse" in accessor:
            raise PopError(f"{path}: attribute {name} is not stored as float32 {_TYPES[width]}; write it so")
        if n == 0:
            return np.zeros((0, width), np.float32)
        entry = content["bufferViews"][accessor["bufferView"]]
        if entry.get("byteStride", 4 * width) != 4 * width:
            raise PopError(f"{path}: attribute {name} is interleaved with others; write it in a buffer view of its own")
        part = _part(content, body, accessor["bufferView"], path)[accessor.get("byteOffset", 0) :]
        if len(part) < 4 * width * n:
            raise PopError(f"{path}: attribute {name} is cut off: {len(part)} bytes for {n} values; {WRITE_AGAIN}")
        return np.frombuffer(part, "<f4", n * width).reshape(n, width)

    degree = next((d for d in (3, 2, 1) if f"{NAME}:SH_DEGREE_{d}_COEF_0" in attributes), 0)
    means = attribute("POSITION", 3)
    bands = [attribute(f"{NAME}:SH_DEGREE_{d}_COEF_{i}", 3) for d in range(1, degree + 1) for i in range(2 * d + 1)]
    opacities = attribute(f"{NAME}:OPACITY", 1)[:, 0].astype(np.float64)
    if len(opacities) and not (opacities.min() >= 0.0 and opacities.max() <= 1.0):
        raise PopError(f"{path}: {NAME}:OPACITY leaves [0, 1]; {WRITE_AGAIN}")
    opacities = np.clip(opacities, np.finfo(np.float32).tiny, _OPAQUE)
    scales = attribute(f"{NAME}:SCALE", 3).astype(np.float64)
    columns = {
        "means": means,
        "log_scales": np.log(np.maximum(scales, 1e-37)).astype(np.float32),
        "quats": attribute(f"{NAME}:ROTATION", 4)[:, [3, 0, 1, 2]],
        "logits": np.log(opacities / (1.0 - opacities)).astype(np.float32),
        "sh0": attribute(f"{NAME}:SH_DEGREE_0_COEF_0", 3),
        "rest": np.stack(bands, axis=1) if bands else np.zeros((len(means), 0, 3), np.float32),
    }
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise PopError(f"{path}: its attributes have different counts ({lengths}); {WRITE_AGAIN}")
    extras = content.get("asset", {}).get("extras")
    # another program's may be anything
    antialiased = isinstance(extras, dict) and bool(extras.get("antialiased", False))
    assert columns["rest"].shape[1] in COEFFICIENTS
    return Cloud(**columns, antialiased=antialiased).turned("z").checked(path)


def _part(content: Mapping[str, Any], body: bytes, index: int, path: Path) -> bytes:
    entry = content["bufferViews"][index]
    if entry.get("buffer", 0) != 0 or "uri" in content["buffers"][0]:
        raise PopError(f"{path}: bufferViews[{index}] lies outside of the file; pack it into one .glb")
    start, length = entry.get("byteOffset", 0), entry["byteLength"]
    if start < 0 or length < 0 or start + length > len(body):
        raise PopError(f"{path}: bufferViews[{index}] reaches beyond the binary chunk; {WRITE_AGAIN}")
    return body[start : start + length]
