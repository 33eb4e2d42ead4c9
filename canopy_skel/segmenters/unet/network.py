"""The network: a small U-Net whose highest level works at a quarter of the picture's size.

Eight maps at half size: branch, middle line (both logits), cos 2θ, sin 2θ, log radius; and of the
piece a pixel lies on, the way to its middle and its log length.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from canopy_skel.frame import Float32Array, UInt8Array

CHANNELS = (16, 32, 64, 128, 192)
"""At 1/2, 1/4, 1/8, 1/16 and 1/32 of the picture's size: 1.8 million parameters."""
_MEAN, _SCALE = 0.45, 0.25
_GAIN, _OFFSET = 1 / (255.0 * _SCALE), _MEAN / _SCALE


class Maps(NamedTuple):
    """What the network says of every second pixel, each (N, H / 2, W / 2).

    branch, centre: logits. cosine, sine: of twice the direction's angle (u right, v down).
    log_radius: natural logarithm of the radius in pixels. middle_u, middle_v: the way to the middle
    of the piece, along it, in its half lengths: 1 long at its ends, 0 in its middle. log_length:
    natural logarithm of the piece's length in pixels.
    """

    branch: Tensor
    centre: Tensor
    cosine: Tensor
    sine: Tensor
    log_radius: Tensor
    middle_u: Tensor
    middle_v: Tensor
    log_length: Tensor


class Known(NamedTuple):
    """All that the network says of one picture.

    maps: (8, h, w), C-contiguous, see `Maps`. features: (K, h, w), what the maps are made of.
    """

    maps: Float32Array
    features: Float32Array


class _Residual(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _convolution(channels, channels)
        self.second = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels)
        )

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.second(self.first(x))
        return y.add_(x).relu_()  # in place: fresh memory takes longer than the sum


def _convolution(inner: int, outer: int, size: int = 3, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inner, outer, size, stride, size // 2, bias=False),
        nn.BatchNorm2d(outer),
        nn.ReLU(inplace=True),
    )


def _enlarged_and_added(x: Tensor, skip: Tensor) -> Tensor:
    """Return a skip (N, C, H, W) and, on each two by two of its cells, one of x."""
    if torch.onnx.is_in_onnx_export():  # one step that every runtime knows
        return functional.interpolate(x, scale_factor=2.0, mode="nearest") + skip
    count, channels, height, width = x.shape
    cells = skip.view(count, channels, height, 2, width, 2)
    # One pass, where interpolating first takes three times as long.
    return (cells + x[:, :, :, None, :, None]).flatten(4, 5).flatten(2, 3)


class UNet(nn.Module):
    """Encoder and decoder with one residual block per level, skips added."""

    def __init__(self, channels: Sequence[int] = CHANNELS) -> None:
        super().__init__()
        self.channels = tuple(channels)
        pairs = list(itertools.pairwise(channels))
        self.stem = _convolution(3, channels[0], size=5, stride=2)
        self.down = nn.ModuleList(_convolution(a, b, stride=2) for a, b in pairs)
        self.encode = nn.ModuleList(_Residual(c) for c in channels[1:])
        self.narrow = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in pairs)
        self.decode = nn.ModuleList(_Residual(c) for c in channels[:-1])
        self.head = nn.Conv2d(channels[0], len(Maps._fields), 1)

    def forward(self, pictures: Tensor) -> Tensor:
        """Return (N, 8, H / 2, W / 2) of `normalised` (N, 3, H, W) pictures; see `Maps`."""
        maps: Tensor = self.head(self.features(pictures))
        return maps

    def known(self, picture: Tensor) -> tuple[Tensor, Tensor]:
        """Return the maps of `forward` of one picture (8, H / 2, W / 2), laid out map by map.

        And the features (channels[0], H / 2, W / 2) that they are made of.
        """
        (features,) = self.features(picture)
        weight, bias = self.head.weight.flatten(1), self.head.get_parameter("bias")
        maps = torch.addmm(bias[:, None], weight, features.flatten(1))
        return maps.view(-1, *features.shape[1:]), features

    def features(self, pictures: Tensor) -> Tensor:
        """Return (N, channels[0], H / 2, W / 2) of `normalised` (N, 3, H, W) pictures."""
        x = self.stem(pictures)
        skips = [x]
        for down, encode in zip(self.down, self.encode, strict=True):
            x = encode(down(x))
            skips.append(x)
        for level in reversed(range(len(self.narrow))):
            x = self.decode[level](_enlarged_and_added(self.narrow[level](x), skips[level]))
        features: Tensor = x
        return features


def channels_last(network: UNet) -> UNet:
    """Lay the weights out as CPUs like them best, in place."""
    for parameter in network.parameters():
        if parameter.dim() == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
    return network


def maps_of(output: Tensor) -> Maps:
    """Split the network's (N, 8, h, w) output."""
    return Maps(*output.float().unbind(dim=1))


def normalised(pictures_rgb: UInt8Array) -> Tensor:
    """Return (N, 3, H, W) float32, channels last, of (N, H, W, 3) uint8 pictures."""
    pictures = torch.from_numpy(pictures_rgb).permute(0, 3, 1, 2).float()
    return pictures.mul_(_GAIN).sub_(_OFFSET)


def scaled(pictures_rgb: Tensor) -> Tensor:
    """Return (N, 3, H, W) pictures of 0 to 255 as the network wants them."""
    return pictures_rgb * _GAIN - _OFFSET
