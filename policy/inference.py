"""The network at work: from a heightmap to Q maps."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch

from policy.encoding import encode
from policy.weights import load_weights

if TYPE_CHECKING:
    from pathlib import Path

    from torch import nn

# Sides of the maps are filled up to a multiple of this, which the network halves four times.
_MULTIPLE = 16


class Inference:
    """A network in evaluation mode, ready to be asked.

    Args:
        network: from encoded heightmaps to Q maps, see `policy.network.QNetwork`.
    """

    def __init__(self, network: nn.Module) -> None:
        self._network = network.eval()
        self._network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in torch's stubs

    @staticmethod
    def load(path: Path) -> Inference:
        """The network of a weights file.

        Raises:
            ConfigError: the file cannot be read, or is not what it should be.
        """
        return Inference(load_weights(path)[0])

    def maps(
        self, height_m: npt.NDArray[np.float32], color: npt.NDArray[np.uint8]
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Q maps of grasps (8, H, W) and pushes (16, H, W).

        Args:
            height_m: (H, W) [m] above the table, NaN = never seen.
            color: (H, W, 3) uint8 RGB.
        """
        rows, cols = height_m.shape
        planes = encode(height_m, color)
        missing = ((0, 0), (0, -rows % _MULTIPLE), (0, -cols % _MULTIPLE))
        x = torch.from_numpy(np.pad(planes, missing))[None].to(memory_format=torch.channels_last)
        with torch.inference_mode():
            grasp, push = self._network(x)
        return grasp[0, :, :rows, :cols].numpy(), push[0, :, :rows, :cols].numpy()
