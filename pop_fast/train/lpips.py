"""LPIPS (Zhang et al. 2018) in plain torch, with weights from local files: nothing is downloaded or shipped.

    d(x, y) = sum over layers l of  mean over pixels of  w_l . (f_l(x) / |f_l(x)| - f_l(y) / |f_l(y)|)^2

where f_l are activations of a fixed network and w_l >= 0 one learnt weight a channel. Three variants are in use and
their numbers cannot be compared, so every value is reported with its name:

    vgg_01      VGG16, images in [0, 1] taken as they are     what 3DGS and its descendants print
    alex_norm   AlexNet, images moved to [-1, 1]              gsplat's default, and the original's intent
    alex_01     AlexNet, images in [0, 1] taken as they are   lpipsPyTorch's default
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

import torch
from torch import Tensor
from torch.nn import functional

from pop_fast.errors import PopError

Variant = Literal["vgg_01", "alex_norm", "alex_01"]
VARIANTS: Final = {"vgg": ("vgg_01",), "alex": ("alex_norm", "alex_01")}
# px; both networks halve or quarter an image several times
SMALLEST_SIDE: Final = 64
# mean and deviation of ImageNet for images in [-1, 1]
_SHIFT: Final = (-0.030, -0.088, -0.188)
_SPREAD: Final = (0.458, 0.448, 0.450)

# (index in torchvision's `features`, channels in, channels out, kernel, stride, padding); "tap" after the relu that is
# compared, "pool" before the next one
_CONV = tuple[int, int, int, int, int, int]
_ALEX: Final[tuple[_CONV | str, ...]] = (
    *((0, 3, 64, 11, 4, 2), "tap", "pool"),
    *((3, 64, 192, 5, 1, 2), "tap", "pool"),
    *((6, 192, 384, 3, 1, 1), "tap"),
    *((8, 384, 256, 3, 1, 1), "tap"),
    *((10, 256, 256, 3, 1, 1), "tap"),
)
_VGG: Final[tuple[_CONV | str, ...]] = (
    *((0, 3, 64, 3, 1, 1), (2, 64, 64, 3, 1, 1), "tap", "pool"),
    *((5, 64, 128, 3, 1, 1), (7, 128, 128, 3, 1, 1), "tap", "pool"),
    *((10, 128, 256, 3, 1, 1), (12, 256, 256, 3, 1, 1), (14, 256, 256, 3, 1, 1), "tap", "pool"),
    *((17, 256, 512, 3, 1, 1), (19, 512, 512, 3, 1, 1), (21, 512, 512, 3, 1, 1), "tap", "pool"),
    *((24, 512, 512, 3, 1, 1), (26, 512, 512, 3, 1, 1), (28, 512, 512, 3, 1, 1), "tap"),
)
_NETS: Final = {"vgg": (_VGG, 2), "alex": (_ALEX, 3)}  # layers, side of the max pooling windows (stride 2)
_CONV_KEY = re.compile(r"(?:features|net\.slice\d+)\.(\d+)\.(weight|bias)")
_LIN_KEY = re.compile(r"lins?\.?(\d)\.(?:model\.)?1\.weight")


class LPIPS:
    """One network with its learnt layer weights.

    Attributes:
        net: "vgg" or "alex".
        sha256: hash of each weight file, by file name.
    """

    def __init__(self, net: Literal["vgg", "alex"], files: Sequence[str | Path]) -> None:
        """Read the weights.

        Args:
            net: "vgg" (VGG16) or "alex" (AlexNet).
            files: one merged state dict, or two: the backbone as torchvision names it (`features.0.weight`) and the
                linear layers as the `lpips` package does (`lin0.model.1.weight`); the order does not matter.

        Raises:
            PopError: a file is absent or damaged, or a tensor is missing or has the wrong shape.
        """
        self.net = net
        self.sha256: dict[str, str] = {}
        self._convs: dict[int, tuple[Tensor, Tensor]] = {}
        self._lins: list[Tensor] = []
        tensors: dict[str, Tensor] = {}
        for file in map(Path, files):
            tensors |= _read(file)
            self.sha256[file.name] = hashlib.sha256(file.read_bytes()).hexdigest()
        self._take(tensors, ", ".join(map(str, files)))

    def __call__(self, image: Tensor, target: Tensor, variant: Variant) -> float:
        """Return the distance of two images in [0, 1]. [H, W, 3]"""
        if variant not in VARIANTS[self.net]:
            raise ValueError(f"variant is {variant!r}; {self.net} computes {', '.join(VARIANTS[self.net])}")
        check_size(*image.shape[:2])
        pair = torch.stack([image, target]).movedim(-1, 1)
        if variant.endswith("_norm"):
            pair = 2.0 * pair - 1.0
        with torch.no_grad():
            layers = [_unit(layer) for layer in self._features(pair)]
            return sum(
                float(((layer[0] - layer[1]) ** 2 * lin).sum(0).mean())
                for layer, lin in zip(layers, self._lins, strict=True)
            )

    def _features(self, pair: Tensor) -> list[Tensor]:
        layers, pool = _NETS[self.net]
        x = (pair - pair.new_tensor(_SHIFT)[:, None, None]) / pair.new_tensor(_SPREAD)[:, None, None]
        taps: list[Tensor] = []
        for layer in layers:
            if layer == "tap":
                taps.append(x)
            elif layer == "pool":
                x = functional.max_pool2d(x, pool, 2)
            else:
                weight, bias = self._convs[int(layer[0])]
                x = functional.relu(functional.conv2d(x, weight, bias, stride=int(layer[4]), padding=int(layer[5])))
        return taps

    def _take(self, tensors: dict[str, Tensor], where: str) -> None:
        layers, _ = _NETS[self.net]
        convs = {(int(m[1]), m[2]): v for k, v in tensors.items() if (m := _CONV_KEY.fullmatch(k))}
        lins = {int(m[1]): v for k, v in tensors.items() if (m := _LIN_KEY.fullmatch(k))}
        width = 3
        for layer in layers:
            if isinstance(layer, tuple):
                index, n_in, width, kernel = layer[:4]
                weight = _tensor(convs, (index, "weight"), (width, n_in, kernel, kernel), where)
                self._convs[index] = weight, _tensor(convs, (index, "bias"), (width,), where)
            elif layer == "tap":
                key = len(self._lins)
                self._lins.append(_tensor(lins, key, (1, width, 1, 1), where)[0])


def check_size(height: int, width: int) -> None:
    """Raise PopError when an image is too small for the networks."""
    if min(height, width) < SMALLEST_SIDE:
        raise PopError(
            f"images of {width} x {height} px are too small for LPIPS, which needs {SMALLEST_SIDE} px a side"
        )


def load_nets(
    vgg: Sequence[str | Path] = (), alex: Sequence[str | Path] = (), sizes: Sequence[tuple[int, int]] = ()
) -> list[LPIPS]:
    """Read the networks whose weight files are given, for images of these sizes (height, width).

    Raises:
        PopError: weights cannot be used, or an image is too small.
    """
    nets = [LPIPS("vgg", vgg)] if vgg else []
    nets += [LPIPS("alex", alex)] if alex else []
    for size in sizes if nets else ():
        check_size(*size)
    return nets


def _tensor(found: dict, key: object, shape: tuple[int, ...], where: str) -> Tensor:
    name = f"features.{key[0]}.{key[1]}" if isinstance(key, tuple) else f"lin{key}.model.1.weight"
    if key not in found:
        raise PopError(f"{where}: has no {name}; give the backbone and the LPIPS linear layers, in one file or two")
    if tuple(found[key].shape) != shape:
        raise PopError(f"{where}: {name} has shape {list(found[key].shape)}; it must be {list(shape)}")
    return found[key].float()


def _read(file: Path) -> dict[str, Tensor]:
    if not file.is_file():
        raise PopError(f"{file}: there is no such file of LPIPS weights")
    try:
        content = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:
        raise PopError(f"{file}: cannot be read as a state dict saved by torch.save") from error
    if not isinstance(content, dict):
        raise PopError(f"{file}: holds {type(content).__name__}; it must be a state dict")
    return {key: value for key, value in content.items() if isinstance(value, Tensor)}


def _unit(layer: Tensor) -> Tensor:
    return layer / (torch.sqrt((layer**2).sum(1, keepdim=True)) + 1e-10)
