"""Poses over time, by one clock."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array


@dataclass(frozen=True)
class Series:
    """Poses over time.

    Attributes:
        t: (N,) growing [s].
        T: (N, 4, 4).
    """

    t: Array
    T: Array

    @cached_property
    def _turning(self) -> Slerp:
        return Slerp(self.t, Rotation.from_matrix(self.T[:, :3, :3]))

    def at(self, t: Array) -> Array:
        """(M, 4, 4) poses at times within the series: position along the chord, rotation by slerp."""
        inside = np.clip(t, self.t[0], self.t[-1])
        T = np.tile(np.eye(4), (len(inside), 1, 1))
        T[:, :3, :3] = self._turning(inside).as_matrix()
        for axis in range(3):
            T[:, axis, 3] = np.interp(inside, self.t, self.T[:, axis, 3])
        return T
