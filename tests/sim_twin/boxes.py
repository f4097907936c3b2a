"""Boxes to look at, and a world of them that only keeps time."""

from dataclasses import dataclass, field

import numpy as np

from robotcell.geometry.transforms import make_transform

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32) / 2
_FACES = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ],
    np.int32,
)  # fmt: skip


@dataclass(frozen=True)
class Box:
    size: tuple[float, float, float]
    color: np.ndarray = field(default_factory=lambda: np.array([200, 200, 200], np.uint8))
    texture: None = None

    @property
    def vertices(self):
        return _CORNERS * np.array(self.size, np.float32)

    @property
    def triangles(self):
        return _FACES


def box_at(x, y, z, rotation=None):
    return make_transform(np.eye(3) if rotation is None else rotation, (x, y, z))


class BoxWorld:
    """Boxes that stand still while time passes."""

    def __init__(self, boxes, poses):
        self.boxes = tuple(boxes)
        self.poses = np.array(poses)
        self.steps = 0
        self.devices = []

    @property
    def time_s(self):
        return self.steps / 240

    def visuals(self):
        return self.boxes

    def visual_poses(self):
        return self.poses

    def step(self, n):
        self.steps += n

    def attach(self, device):
        self.devices.append(device)

    def detach(self, device):
        self.devices.remove(device)


def table_with_blocks(count=12, seed=3):
    """A table under the default camera, with coloured blocks on it."""
    rng = np.random.default_rng(seed)
    boxes, poses = [Box((1.2, 1.2, 0.04))], [box_at(-0.5, 0, -0.02)]
    for _ in range(count):
        boxes.append(Box((0.05, 0.05, 0.05), rng.integers(40, 255, 3).astype(np.uint8)))
        poses.append(box_at(*rng.uniform((-0.65, -0.18, 0.025), (-0.35, 0.18, 0.025))))
    return BoxWorld(boxes, poses)
