"""What a person who writes ten lines of Python needs, in the twin."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import robotcell
from robotcell.motion.tool import solve_tool_down, tool_down

CONFIG = robotcell.load_config(None, {"backend.options.objects": 1})


def test_every_public_name_is_there() -> None:
    for name in robotcell.__all__:
        assert getattr(robotcell, name) is not None
    assert set(robotcell.__all__) <= set(dir(robotcell))
    with pytest.raises(AttributeError, match="no attribute 'open_sell'"):
        _ = robotcell.open_sell


def test_importing_the_package_costs_nothing() -> None:
    code = (
        "import sys, robotcell; "
        "heavy = {'numpy', 'cv2', 'scipy', 'pydantic'} & set(sys.modules); assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_cell_looks_moves_and_grips() -> None:
    with robotcell.open_cell(CONFIG) as cell:
        view = cell.look()
        assert len(view.segmentation.instances) == 1
        stayed = cell.move(T_base_tcp=cell.arm.state().T_base_tcp)  # where it stands: nothing to do
        assert stayed.ending is robotcell.Ending.DONE
        home = np.array(CONFIG.motion.home_q)
        turned = home + np.array([0.2, 0, 0, 0, 0, 0])
        cell.move(joints=turned, speed=1.0)
        np.testing.assert_allclose(cell.arm.state().q, turned, atol=0.005)
        cell.home()
        cell.move(T_base_tcp=_straight(cell, 0.05), speed=0.2)
        cell.grip(0.03)
        assert cell.gripper.state().width_m == pytest.approx(0.03, abs=0.002)


def test_a_straight_motion_ends_at_a_contact_force() -> None:
    with robotcell.open_cell(CONFIG) as cell:
        (block,) = cell.look().segmentation.instances
        x, y = block.centroid
        cell.grip(0.0)
        high = joints_above(x, y, block.height_m + 0.10)
        cell.move(joints=high)
        met = cell.move(T_base_tcp=tool_down(x, y, 0.01, 0.0), contact_force_n=15.0)
        assert met.ending is robotcell.Ending.CONTACT
        assert cell.arm.state().T_base_tcp[2, 3] == pytest.approx(block.height_m, abs=0.012)


@pytest.mark.parametrize("arguments", [{}, {"joints": [0.0] * 6, "T_base_tcp": np.eye(4)}])
def test_a_move_needs_one_target(arguments: dict[str, object]) -> None:
    with robotcell.open_cell(CONFIG) as cell, pytest.raises(ValueError, match="either joints, or T_base_tcp"):
        cell.move(**arguments)  # type: ignore[arg-type]


def test_what_is_not_safe_is_refused_and_nothing_moves() -> None:
    with robotcell.open_cell(CONFIG) as cell:
        q = cell.arm.state().q
        for wrong in ({"joints": np.full(6, 9.0)}, {"T_base_tcp": tool_down(-0.5, 0.0, -0.05, 0.0)}):
            with pytest.raises(robotcell.UnsafeMotion):
                cell.move(**wrong)
        with pytest.raises(robotcell.UnsafeMotion, match="width"):
            cell.grip(0.2)
        np.testing.assert_allclose(cell.arm.state().q, q, atol=1e-3)


def _straight(cell: robotcell.Cell, up_m: float) -> np.ndarray:
    T = cell.arm.state().T_base_tcp.copy()
    T[2, 3] += up_m
    return T


def joints_above(x: float, y: float, z: float) -> np.ndarray:
    """Joint angles of the tool pointing down at a place of the table."""
    return solve_tool_down("above", tool_down(x, y, z, 0.0), CONFIG)
