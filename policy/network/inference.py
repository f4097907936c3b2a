"""The network at work: from a heightmap to Q maps of all rotations."""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from policy.network.encoding import GRASP, PUSH, RESOLUTION_M
from policy.network.precision import autocast
from policy.network.rotation import Copies
from policy.network.weights import load_weights
from robotcell.motion.rotations import GRASP_ROTATIONS, ROTATIONS

if TYPE_CHECKING:
    from pathlib import Path

# How far around its cell a Q value depends on what stands there: the fingers' reach, and what a push meets first.
# Copies that show more tell labelled attempts apart no better (`docs/explanation/experiments/networks.md`).
MARGIN_M = 0.064
_PLANES = {GRASP: GRASP_ROTATIONS, PUSH: ROTATIONS}
# Cells of copies that pass the network at once: what the paper's network keeps of them takes 1 GB. Neither network is
# faster on more.
CELLS_AT_ONCE = 2**19


class Inference:
    """A network in evaluation mode, ready to be asked.

    Args:
        network: Q maps of grasps and pushes along +x, see `policy.network.q_network.QNetwork`.
        margin_m: how far around the cells in question the network is shown the map.
        cells_at_once: cells of copies that pass the network together, or one copy if it is larger.
    """

    def __init__(self, network: nn.Module, margin_m: float = MARGIN_M, cells_at_once: int = CELLS_AT_ONCE) -> None:
        self._cells_at_once = cells_at_once
        self._margin = round(margin_m / RESOLUTION_M)
        self._network = copy.deepcopy(network).eval()
        fuse_norms(self._network)
        self._network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in torch's stubs

    @staticmethod
    def load(path: Path) -> Inference:
        """The network of a weights file.

        Raises:
            ConfigError: the file cannot be read, or is not what it should be.
        """
        return Inference(load_weights(path)[0])

    def maps(
        self, planes: npt.NDArray[np.float32], cells: npt.NDArray[np.bool_], primitive: int
    ) -> npt.NDArray[np.float32]:
        """Q maps (K, H, W) of a primitive, 8 for grasps and 16 for pushes; NaN outside of the cells.

        Args:
            planes: (5, H, W) encoded heightmap.
            cells: (H, W) that are asked for in all rotations, or (K, H, W) in each; at least one.
            primitive: `GRASP` or `PUSH`.
        """
        each = np.broadcast_to(cells, (_PLANES[primitive], *cells.shape[-2:]))
        rotations = np.flatnonzero(each.any(axis=(1, 2)))
        copies = Copies.around(each[rotations], rotations.tolist(), self._margin)
        x = torch.from_numpy(copies.turn(planes))
        at_once = max(1, self._cells_at_once // math.prod(copies.shape))
        with torch.inference_mode(), autocast(x.device):
            q = torch.cat([self._network(x[i : i + at_once])[:, primitive] for i in range(0, len(x), at_once)])
        maps = np.full(each.shape, np.nan, np.float32)
        maps[rotations[:, None], copies.rows, copies.cols] = copies.values(q.float().numpy())
        return maps


def fuse_norms(network: nn.Module) -> None:
    """Multiply each norm that follows a convolution into it: the same network for inference, and faster."""
    for child in network.children():
        fuse_norms(child)
    if isinstance(network, nn.Sequential):
        for i in range(len(network) - 1):
            conv, norm = network[i], network[i + 1]
            if isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                network[i], network[i + 1] = fuse_conv_bn_eval(conv, norm), nn.Identity()
