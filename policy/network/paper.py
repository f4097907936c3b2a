"""The network in the paper's form: two DenseNet-121 trunks on the doubled heightmap.

It exists to be compared with `policy.network.q_network`, which gives the same maps at a small share of the cost. The
text of the paper leaves open, and here it is settled as follows:

- Strides are counted in cells of the heightmap. The input is doubled, so that the last features of an unchanged
  DenseNet-121 (stride 32) have stride 16 in cells and those of its second block (stride 8) have stride 4, and two
  bilinear x4 lead back to one Q value per cell. Whole trunks also are what the count of 18.4 M parameters asks for: two
  of them have 13.9 M, two that end after the third block 8.5 M.
- Both taps are taken after norm and ReLU: of the second block where its transition applies them, of the fourth where
  the classifier would.
- The modules halve the 2048 channels to 1024, and narrow these and 2 x 512 of the skip to 64; both convolutions are
  followed by norm and ReLU. This brings the count to 18.37 M.
- The 16 rotated copies are those of `policy.network.rotation`, which show the surroundings of the cells that are asked
for; the
  paper's show the whole map (320 x 320 cells, doubled to 640 x 640). A grasp and the same grasp after half a turn are
  one grasp, looked for in one of the two copies.
- Weights start as PyTorch initialises layers by default. The paper starts from ImageNet's, which are not shipped here.

DenseNet: Huang, Liu, van der Maaten, Weinberger, "Densely Connected Convolutional Networks", CVPR 2017, table 1.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import nn
from torch.nn import functional

if TYPE_CHECKING:
    from torch import Tensor

# Channels of `policy.network.encoding.encode`; the paper's network is not told where nothing was seen.
_HEIGHT = slice(0, 1)
_COLOR = slice(2, 5)

# DenseNet-121: layers of each block; channels that a layer adds; width of its bottleneck in units of that; channels
# of the stem.
_LAYERS = (6, 12, 24, 16)
_GROWTH = 32
_BOTTLENECK = 4
_STEM = 64
# Channels of its second and fourth block: (64 + 6 * 32) / 2 + 12 * 32, and (512 / 2 + 24 * 32) / 2 + 16 * 32.
_FINE = 512
_COARSE = 1024

_WIDTHS = (1024, 64)
_UPSAMPLING = 4
_DOUBLING = 2


class PaperNetwork(nn.Module):
    """Q maps (B, 2, H, W) of grasps and of pushes along +x, from encoded heightmaps (B, 5, H, W) float32.

    As `policy.network.q_network.QNetwork`: see `policy.network.encoding.encode` for the input; H and W are multiples of
    16.
    """

    def __init__(self) -> None:
        super().__init__()
        self.color = _Trunk()
        self.height = _Trunk()
        self.grasp = _Module()
        self.push = _Module()

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        doubled = _enlarge(x, _DOUBLING)
        color = self.color(doubled[:, _COLOR])
        height = self.height(doubled[:, _HEIGHT].expand(-1, 3, -1, -1))
        fine, coarse = (torch.cat(pair, dim=1) for pair in zip(color, height, strict=True))
        return torch.cat([self.grasp(fine, coarse), self.push(fine, coarse)], dim=1)


class _Module(nn.Module):
    """Q map (B, 1, 16 h, 16 w) from fine (B, 2 * 512, 4 h, 4 w) and coarse (B, 2 * 1024, h, w) features."""

    def __init__(self) -> None:
        super().__init__()
        wide, narrow = _WIDTHS
        self.first = _narrow(2 * _COARSE, wide)
        self.second = _narrow(wide + 2 * _FINE, narrow)
        self.last = nn.Conv2d(narrow, 1, 1)

    def forward(self, fine: Tensor, coarse: Tensor) -> Tensor:
        x = self.second(torch.cat([_enlarge(self.first(coarse), _UPSAMPLING), fine], dim=1))
        y: Tensor = self.last(_enlarge(x, _UPSAMPLING))
        return y


def _narrow(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


def _enlarge(x: Tensor, factor: int) -> Tensor:
    return functional.interpolate(x, scale_factor=factor, mode="bilinear", align_corners=False)


class _Trunk(nn.Module):
    """DenseNet-121 without its classifier: (B, 3, h, w) to (B, 512, h / 8, w / 8) and (B, 1024, h / 32, w / 32)."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            nn.Conv2d(3, _STEM, 7, stride=2, padding=3, bias=False),
            nn.BatchNorm2d(_STEM),
            nn.ReLU(inplace=True),
            nn.MaxPool2d(3, stride=2, padding=1),
        )
        width = _STEM
        self.blocks = nn.ModuleList()
        self.activations = nn.ModuleList()
        self.transitions = nn.ModuleList()
        for layers in _LAYERS:
            self.blocks.append(nn.Sequential(*[_DenseLayer(width + i * _GROWTH) for i in range(layers)]))
            width += layers * _GROWTH
            self.activations.append(nn.Sequential(nn.BatchNorm2d(width), nn.ReLU(inplace=True)))
            last = len(self.blocks) == len(_LAYERS)
            self.transitions.append(nn.Identity() if last else _transition(width))
            width //= 2

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        x = self.stem(x)
        taps: list[Tensor] = []
        for block, activation, transition in zip(self.blocks, self.activations, self.transitions, strict=True):
            taps.append(activation(block(x)))
            x = transition(taps[-1])
        return taps[1], taps[3]


def _transition(width: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(width, width // 2, 1, bias=False), nn.AvgPool2d(2))


class _DenseLayer(nn.Module):
    """Adds 32 channels to those it is given."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.BatchNorm2d(inputs),
            nn.ReLU(inplace=True),
            nn.Conv2d(inputs, _BOTTLENECK * _GROWTH, 1, bias=False),
            nn.BatchNorm2d(_BOTTLENECK * _GROWTH),
            nn.ReLU(inplace=True),
            nn.Conv2d(_BOTTLENECK * _GROWTH, _GROWTH, 3, padding=1, bias=False),
        )

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([x, self.body(x)], dim=1)
