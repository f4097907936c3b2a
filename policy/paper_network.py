"""The network in the paper's form: two DenseNet-121 trunks see 16 rotated copies of the heightmap.

It exists to be compared with `policy.network`, which gives the same maps at a small share of the cost. The text of the
paper leaves open, and here it is settled as follows:

- Strides are counted in cells of the heightmap. The input is doubled, so that the last features of an unchanged
  DenseNet-121 (stride 32) have stride 16 in cells and those of its second block (stride 8) have stride 4, and two
  bilinear x4 lead back to one Q value per cell. Whole trunks also are what the count of 18.4 M parameters asks for: two
  of them have 13.9 M, two that end after the third block 8.5 M.
- Both taps are taken after norm and ReLU: of the second block where its transition applies them, of the fourth where
  the classifier would.
- The modules halve the 2048 channels to 1024, and narrow these and 2 x 512 of the skip to 64; both convolutions are
  followed by norm and ReLU. This brings the count to 18.37 M.
- A copy is rotated and doubled by one bilinear resampling with zeros around the map.
- All 16 copies pass the trunks and both modules. A grasp and the same grasp after half a turn are one grasp: its Q
  value is the mean over the two copies.
- Weights start as PyTorch initialises layers by default. The paper starts from ImageNet's, which are not shipped here.

DenseNet: Huang, Liu, van der Maaten, Weinberger, "Densely Connected Convolutional Networks", CVPR 2017, table 1.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from policy.network import GRASP_ROTATIONS
from robotcell.decision import ROTATIONS

if TYPE_CHECKING:
    from torch import Tensor

# Channels of `policy.encoding.encode`; the paper's network is not told where nothing was seen.
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
# Stride of the coarse features in cells.
_STRIDE = 16


class PaperNetwork(nn.Module):
    """Q maps of grasps and pushes from encoded heightmaps, one rotated copy after the other.

    `forward` takes and returns what `policy.network.QNetwork` does: (B, 5, H, W) float32 to (B, 8, H, W) of grasps and
    (B, 16, H, W) of pushes; any H and W will do. Where gradients are recorded, each copy is computed a second time in
    the backward pass, for the activations of 16 copies do not fit into memory; the running statistics of the norms
    then count each batch twice.
    """

    def __init__(self) -> None:
        super().__init__()
        self.color = _Trunk()
        self.height = _Trunk()
        self.grasp = _Module()
        self.push = _Module()

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """See the class."""
        copies = [
            checkpoint(self._copy, x, k, use_reentrant=False) if torch.is_grad_enabled() else self._copy(x, k)
            for k in range(ROTATIONS)
        ]
        grasp = torch.stack([g for g, _ in copies], dim=1)
        push = torch.stack([p for _, p in copies], dim=1)
        return (grasp[:, :GRASP_ROTATIONS] + grasp[:, GRASP_ROTATIONS:]) / 2, push

    def _copy(self, x: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """Q maps (B, H, W) of rotation k: in its copy of the map, the action runs along +x."""
        rows, cols = x.shape[2:]
        # Holds the map at every rotation (224 -> 320).
        side = math.ceil(math.hypot(rows, cols) / _STRIDE) * _STRIDE
        theta = 2 * math.pi * k / ROTATIONS
        cos, sin = math.cos(theta), math.sin(theta)
        # Both in units of the half sides of what is sampled and of what results.
        out = [[side * cos / cols, -side * sin / cols, 0.0], [side * sin / rows, side * cos / rows, 0.0]]
        back = [[cols * cos / side, rows * sin / side, 0.0], [-cols * sin / side, rows * cos / side, 0.0]]
        copy = _resample(x, out, (_DOUBLING * side, _DOUBLING * side))
        # Convolutions on the processor are faster on channels that lie together in memory.
        color = self.color(copy[:, _COLOR].contiguous(memory_format=torch.channels_last))
        height = self.height(copy[:, _HEIGHT].expand(-1, 3, -1, -1).contiguous(memory_format=torch.channels_last))
        fine, coarse = (torch.cat(pair, dim=1) for pair in zip(color, height, strict=True))
        q = torch.cat([self.grasp(fine, coarse), self.push(fine, coarse)], dim=1)
        grasp, push = _resample(q, back, (rows, cols)).unbind(dim=1)
        return grasp, push


def _resample(maps: Tensor, affine: list[list[float]], size: tuple[int, int]) -> Tensor:
    """Sample maps (B, C, *, *) at `affine` (2 x 3) of the cells of a map of the given size; zero outside."""
    grid = functional.affine_grid(
        maps.new_tensor(affine).expand(len(maps), -1, -1), [*maps.shape[:2], *size], align_corners=False
    )
    return functional.grid_sample(maps, grid, mode="bilinear", padding_mode="zeros", align_corners=False)


class _Module(nn.Module):
    """Q map (B, 1, 16 h, 16 w) from fine (B, 2 * 512, 4 h, 4 w) and coarse (B, 2 * 1024, h, w) features."""

    def __init__(self) -> None:
        super().__init__()
        wide, narrow = _WIDTHS
        self.first = _narrow(2 * _COARSE, wide)
        self.second = _narrow(wide + 2 * _FINE, narrow)
        self.last = nn.Conv2d(narrow, 1, 1)

    def forward(self, fine: Tensor, coarse: Tensor) -> Tensor:
        x = self.second(torch.cat([_enlarge(self.first(coarse)), fine], dim=1))
        y: Tensor = self.last(_enlarge(x))
        return y


def _narrow(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


def _enlarge(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=_UPSAMPLING, mode="bilinear", align_corners=False)


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
