"""The network: one pass over the RGB-D heightmap gives dense Q maps of all rotations at the heightmap's resolution.

A shared perception (an encoder and a decoder with skip connections) feeds a grasp module and a push module. It works
on blocks of 2 x 2 cells and ends by unfolding them again, so its maps are as fine as the heightmap at a quarter of the
cost. The rotations are output channels: the paper rotates the input 16 times instead (`policy.paper_network`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import nn
from torch.nn import functional

from policy.encoding import CHANNELS
from robotcell.decision import ROTATIONS

if TYPE_CHECKING:
    from torch import Tensor

# The jaw is symmetric: half a turn changes nothing.
GRASP_ROTATIONS = ROTATIONS // 2
PUSH_ROTATIONS = ROTATIONS

_FOLD = 2
_WIDTHS = (32, 48, 96, 128)


class QNetwork(nn.Module):
    """Q maps of grasps and pushes from encoded heightmaps.

    `forward` takes (B, 5, H, W) float32 (`policy.encoding.encode`; H and W multiples of 16) and returns the Q maps of
    grasps (B, 8, H, W), plane k closing along k * 22.5 degrees, and of pushes (B, 16, H, W), plane k pushing along it.
    """

    def __init__(self) -> None:
        super().__init__()
        a, b, c, d = _WIDTHS
        self.stem = _block(CHANNELS * _FOLD**2, a)
        self.down = nn.ModuleList([_Down(a, b), _Down(b, c), _Down(c, d)])
        self.up = nn.ModuleList([_Up(d, c, c), _Up(c, b, b), _Up(b, a, a)])
        self.grasp = _head(a, GRASP_ROTATIONS)
        self.push = _head(a, PUSH_ROTATIONS)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """See the class."""
        features = self.stem(functional.pixel_unshuffle(x, _FOLD))
        skips = []
        for down in self.down:
            skips.append(features)
            features = down(features)
        for up in self.up:
            features = up(features, skips.pop())
        return self.grasp(features), self.push(features)


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
        from torch import cat

        grown = functional.interpolate(self.narrow(x), scale_factor=2, mode="bilinear", align_corners=False)
        y: Tensor = self.body(cat([grown, skip], dim=1))
        return y


def _head(width: int, rotations: int) -> nn.Sequential:
    return nn.Sequential(
        _block(width, width),
        nn.Conv2d(width, rotations * _FOLD**2, 1),
        nn.PixelShuffle(_FOLD),
    )
