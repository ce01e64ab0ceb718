"""LPIPS with random weights of a fixed seed: the layers, the three variants, and the two ways to give weights."""

from __future__ import annotations

import hashlib

import pytest
import torch
from torch import nn

from pop_fast.errors import PopError
from pop_fast.train import TrainingRun
from pop_fast.train.evaluate import average, measure
from pop_fast.train.lpips import LPIPS, load_nets
from tests.app.captures import assert_one_line
from tests.app.tiny import tiny_capture, tiny_config

# the networks as torchvision lays them out: of a convolution its width, kernel, stride and padding, and "M", a pool
VGG = [*[(64, 3, 1, 1)] * 2, "M", *[(128, 3, 1, 1)] * 2, "M", *[(256, 3, 1, 1)] * 3, "M"]
VGG += [*[(512, 3, 1, 1)] * 3, "M"] * 2
ALEX = [(64, 11, 4, 2), "M", (192, 5, 1, 2), "M", (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1), "M"]
# with the last layer of each slice whose output is compared, and the widths there
NETS = {
    "vgg": (VGG, 2, (3, 8, 15, 22, 29), (64, 128, 256, 512, 512)),
    "alex": (ALEX, 3, (1, 4, 7, 9, 11), (64, 192, 384, 256, 256)),
}


def made(layout, pool):
    layers: list[nn.Module] = []
    before = 3
    for entry in layout:
        if entry == "M":
            layers.append(nn.MaxPool2d(pool, 2))
        else:
            layers += [nn.Conv2d(before, *entry), nn.ReLU()]
            before = entry[0]
    return nn.Sequential(*layers).eval()


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """For each net: the features module, the linear weights, and its files."""
    folder = tmp_path_factory.mktemp("weights")
    found = {}
    for net, (layout, pool, _, widths) in NETS.items():
        torch.manual_seed(5)
        features = made(layout, pool)
        backbone = {f"features.{key}": value for key, value in features.state_dict().items()}
        backbone["classifier.6.weight"] = torch.zeros(2, 2)
        lins = {f"lin{i}.model.1.weight": torch.rand(1, width, 1, 1) for i, width in enumerate(widths)}
        paths = [folder / f"{net}_backbone.pth", folder / f"{net}_lin.pth", folder / f"{net}_merged.pth"]
        for path, content in zip(paths, (backbone, lins, {**backbone, **lins}), strict=True):
            torch.save(content, path)
        found[net] = features, list(lins.values()), paths
    return found


def pictures(size=80):
    g = torch.Generator().manual_seed(0)
    image = torch.rand(size, size + 3, 3, generator=g)
    return image, (image + 0.1 * torch.randn(image.shape, generator=g)).clamp(0, 1)


def by_the_book(features, lins, taps, image, target, rescaled):
    """The definition, with torch's own layers."""
    shift, spread = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    total = 0.0
    with torch.no_grad():
        x, y = (((2 * p - 1 if rescaled else p) - shift) / spread for p in (image, target))
        x, y = x.permute(2, 0, 1)[None], y.permute(2, 0, 1)[None]
        for i, layer in enumerate(features):
            x, y = layer(x), layer(y)
            if i in taps:
                fx, fy = (f / (f.square().sum(1, keepdim=True).sqrt() + 1e-10) for f in (x, y))
                total += nn.functional.conv2d((fx - fy) ** 2, lins[taps.index(i)]).mean().item()
    return total


@pytest.mark.parametrize(("net", "variant"), [("vgg", "vgg_01"), ("alex", "alex_norm"), ("alex", "alex_01")])
def test_each_variant_follows_the_definition(weights, net, variant):
    features, lins, paths = weights[net]
    got = LPIPS(net, paths[2:])(*pictures(), variant)
    want = by_the_book(features, lins, NETS[net][2], *pictures(), variant.endswith("norm"))
    assert got == pytest.approx(want, rel=1e-4)
    assert got > 0.0


def test_two_files_in_any_order_and_the_lpips_packages_own_equal_one_merged_file(weights, tmp_path):
    paths = weights["alex"][2]
    slices = {0: 1, 3: 2, 6: 3, 8: 4, 10: 5}
    package = torch.load(paths[1], weights_only=True) | {"scaling_layer.shift": torch.zeros(3)}
    for key, value in torch.load(paths[0], weights_only=True).items():
        if key.startswith("features."):
            index, kind = key.split(".")[1:]
            package[f"net.slice{slices[int(index)]}.{index}.{kind}"] = value
    torch.save(package, tmp_path / "package.pth")
    merged = LPIPS("alex", paths[2:])
    for files in (paths[:2], paths[1::-1], [tmp_path / "package.pth"]):
        assert LPIPS("alex", files)(*pictures(), "alex_norm") == merged(*pictures(), "alex_norm")
    image, _ = pictures()
    assert merged(image, image, "alex_norm") == 0.0


def test_hashes_of_the_weight_files_are_reported_with_every_variant(weights):
    nets = load_nets(vgg=weights["vgg"][2][2:], alex=weights["alex"][2][:2])
    image, target = pictures()
    means = average([measure(image, target, nets=nets)], nets)
    assert set(means["lpips_variants"]) == {"vgg_01", "alex_norm", "alex_01"}
    assert (means["lpips_net"], means["lpips"]) == ("alex_norm", means["lpips_variants"]["alex_norm"])
    assert means["lpips_reason"] is None
    files = {path.name: path for net in weights.values() for path in net[2]}
    assert len(means["lpips_weights_sha256"]) == 3
    for name, value in means["lpips_weights_sha256"].items():
        assert value == hashlib.sha256(files[name].read_bytes()).hexdigest()
    nets = load_nets(vgg=weights["vgg"][2][2:])
    assert average([measure(*pictures(), nets=nets)], nets)["lpips_net"] == "vgg_01"


def test_a_variant_of_the_other_net_and_pictures_too_small_for_the_nets_are_refused(weights, tmp_path):
    net = LPIPS("alex", weights["alex"][2][2:])
    with pytest.raises(ValueError, match="alex computes alex_norm, alex_01"):
        net(*pictures(), "vgg_01")
    with pytest.raises(PopError, match="images of 66 x 63 px are too small for LPIPS, which needs 64 px a side"):
        net(*pictures(63), "alex_01")
    assert net(*pictures(64), "alex_01") > 0.0
    # before training
    config = tiny_config(tmp_path, lpips_alex=tuple(map(str, weights["alex"][2][2:])))
    with pytest.raises(PopError, match="32 x 24 px are too small for LPIPS"):
        TrainingRun(config, tiny_capture())


def test_bad_weight_files_are_named(weights, tmp_path):
    backbone, lins, merged = weights["alex"][2]
    (tmp_path / "text.pth").write_text("hello")
    torch.save([1], tmp_path / "list.pth")
    for net, path, told in (
        ("alex", tmp_path / "absent.pth", "no such file"),
        ("alex", tmp_path / "text.pth", "text.pth: cannot be read"),
        ("alex", tmp_path / "list.pth", "holds list"),
        ("alex", backbone, "has no lin0.model.1.weight; give the backbone and"),
        ("alex", lins, "has no features.0.weight"),
        ("vgg", merged, "features.0.weight has shape [64, 3, 11, 11]; it must be [64, 3, 3, 3]"),
    ):
        assert_one_line(lambda net=net, path=path: LPIPS(net, [path]), told)
