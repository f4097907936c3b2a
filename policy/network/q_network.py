"""The network: Q maps of grasping and pushing along +x of the map that it is shown.

A shared perception (an encoder and a decoder with skip connections) feeds a grasp module and a push module. The other
directions come from turning the map (`policy.network.rotation`), so that everything learned of one holds for all.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import nn
from torch.nn import functional

from policy.network.encoding import CHANNELS

if TYPE_CHECKING:
    from torch import Tensor


# The network works on blocks of 4 x 4 cells (8 mm), with all that is in them as channels.
_FOLD = 4
_WIDTHS = (32, 48, 80)


class QNetwork(nn.Module):
    """Q maps (B, 2, H, W) of grasps and of pushes along +x, from encoded heightmaps (B, 5, H, W) float32.

    See `policy.network.encoding.encode` for the input; H and W are multiples of 16.
    """

    def __init__(self) -> None:
        super().__init__()
        a, b, c = _WIDTHS
        self.stem = nn.Sequential(_block(CHANNELS * _FOLD**2, a), _Residual(a))
        self.down = nn.ModuleList([_Down(a, b), _Down(b, c)])
        self.up = nn.ModuleList([_Up(c, b, b), _Up(b, a, a)])
        self.grasp = _head(a)
        self.push = _head(a)

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        features = self.stem(functional.pixel_unshuffle(x, _FOLD))
        skips = []
        for down in self.down:
            skips.append(features)
            features = down(features)
        for up in self.up:
            features = up(features, skips.pop())
        q = torch.cat([self.grasp(features), self.push(features)], dim=1)
        # Two channels are enlarged several times faster one after the other than side by side.
        return _enlarge(q.float().contiguous(), _FOLD)


def _block(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = _block(width, width)
        self.second = nn.Sequential(nn.Conv2d(width, width, 3, padding=1, bias=False), nn.BatchNorm2d(width))

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.second(self.first(x)))


class _Down(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.body = nn.Sequential(nn.MaxPool2d(2), _block(inputs, outputs), _Residual(outputs))

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.body(x)
        return y


class _Up(nn.Module):
    def __init__(self, inputs: int, skip: int, outputs: int) -> None:
        super().__init__()
        self.narrow = nn.Sequential(nn.Conv2d(inputs, skip, 1, bias=False), nn.BatchNorm2d(skip))
        self.body = nn.Sequential(_block(2 * skip, outputs), _Residual(outputs))

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        y: Tensor = self.body(torch.cat([_enlarge(self.narrow(x)), skip], dim=1))
        return y


def _head(width: int) -> nn.Sequential:
    return nn.Sequential(_block(width, width), nn.Conv2d(width, 1, 1))


def _enlarge(x: Tensor, factor: int = 2) -> Tensor:
    return functional.interpolate(x, scale_factor=factor, mode="bilinear", align_corners=False)
