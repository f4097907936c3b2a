"""Draws a twin world with the engine's own renderer, to look at it: `python -m tests.sim_twin.picture OUT.png`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pybullet
from PIL import Image
from scipy.spatial.transform import Rotation

from robotcell.cell import open_cell
from robotcell.config import load_config

if TYPE_CHECKING:
    import numpy.typing as npt

    from sim_twin.world.world import World


def draw(
    world: World,
    eye: tuple[float, float, float],
    target: tuple[float, float, float],
    size: tuple[int, int] = (960, 720),
) -> npt.NDArray[np.uint8]:
    """An (H, W, 3) picture of exactly what the twin's camera would be given to render."""
    client = pybullet.connect(pybullet.DIRECT)
    try:
        for visual, T in zip(world.visuals(), world.visual_poses(), strict=True):
            shape = pybullet.createVisualShape(
                pybullet.GEOM_MESH,
                vertices=visual.vertices[visual.triangles.ravel()].tolist(),
                indices=list(range(visual.triangles.size)),
                normals=np.repeat(_normals(visual.vertices, visual.triangles), 3, axis=0).tolist(),
                rgbaColor=[*(visual.color / 255.0), 1],
                physicsClientId=client,
            )
            turn = Rotation.from_matrix(T[:3, :3]).as_quat()
            pybullet.createMultiBody(0, -1, shape, T[:3, 3].tolist(), turn.tolist(), physicsClientId=client)
        view = pybullet.computeViewMatrix(eye, target, (0, 0, 1))
        projection = pybullet.computeProjectionMatrixFOV(45, size[0] / size[1], 0.05, 5)
        image = pybullet.getCameraImage(
            *size, view, projection, lightDirection=(-0.5, 0.6, 2), shadow=1, physicsClientId=client
        )
        return np.reshape(image[2], (size[1], size[0], 4))[:, :, :3].astype(np.uint8)
    finally:
        pybullet.disconnect(physicsClientId=client)


def _normals(vertices: npt.NDArray[np.float32], triangles: npt.NDArray[np.int32]) -> npt.NDArray[np.float32]:
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


if __name__ == "__main__":
    cell = open_cell(load_config())
    with cell.arm as arm:
        picture = draw(arm._world, (-1.0, -1.1, 0.8), (-0.3, 0.05, 0.25))
    Image.fromarray(picture).save(Path(sys.argv[1]))
