from __future__ import annotations

import numpy as np

from robotcell.config import CellConfig, KeepOut
from robotcell.config.surroundings import camera_post, obstacles


def test_the_post_stands_behind_the_camera_and_a_hanging_camera_has_none() -> None:
    config = CellConfig()
    post = camera_post(config)
    assert post is not None
    assert post.x[1] < config.camera.position[0] < config.workspace.x[0]
    above = CellConfig.model_validate({"camera": {"position": (-0.5, 0.0, 0.9), "look_at": (-0.5, 0.0, 0.0)}})
    assert camera_post(above) is None
    assert [box.name for box in obstacles(above)] == ["bin", "camera"]


def test_a_keep_out_lies_between_its_corners() -> None:
    low, high = KeepOut(name="box", x=(-1, 1), y=(0, 2), z=(0, 0.5)).corners()
    np.testing.assert_array_equal(low, (-1, 0, 0))
    np.testing.assert_array_equal(high, (1, 2, 0.5))
