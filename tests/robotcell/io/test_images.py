from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from robotcell.errors import StorageError
from robotcell.io.images import write_image

if TYPE_CHECKING:
    from pathlib import Path


def test_colours_and_depths_come_back_as_they_were(tmp_path: Path) -> None:
    color = np.zeros((4, 5, 3), np.uint8)
    color[0, 0] = (255, 128, 1)
    depth = np.arange(20, dtype=np.uint16).reshape(4, 5) * 3000
    write_image(tmp_path / "new" / "color.png", color)
    write_image(tmp_path / "new" / "depth.png", depth)
    stored = cv2.imread(str(tmp_path / "new" / "color.png"))
    assert stored is not None
    np.testing.assert_array_equal(stored[..., ::-1], color)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "new" / "depth.png"), cv2.IMREAD_UNCHANGED), depth)


def test_a_place_that_is_no_folder_is_a_storage_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(StorageError, match="cannot be made"):
        write_image(tmp_path / "file" / "color.png", np.zeros((2, 2, 3), np.uint8))
