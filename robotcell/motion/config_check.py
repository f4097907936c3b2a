"""Whether the parts of a cell's file fit each other."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from robotcell.config.fingers import finger_problems, gripper_range
from robotcell.config.surroundings import obstacles
from robotcell.errors import ConfigError, UnsafeMotion
from robotcell.geometry import ur5e
from robotcell.geometry.bodies import blocks_view
from robotcell.motion.path_check import check_poses, joint_path, outside_box
from robotcell.motion.plan import JointMove
from robotcell.motion.tool import flange_pose, tool_down

if TYPE_CHECKING:
    from collections.abc import Iterator

    from robotcell.config import CellConfig

# Rounding of positions that lie on a limit.
_ROUNDING_M = 1e-6


def check_config(config: CellConfig) -> None:
    """Check that the parts of a configuration fit each other.

    Raises:
        ConfigError: naming everything that does not: speeds or forces over their limits, a pre-shape that the mounted
            finger tips cannot reach, a home pose that is unsafe or in the view of the camera, a workspace or a bin that
            the arm may not or cannot reach.
    """
    problems = [*finger_problems(config, gripper_range(config)), *_over_limits(config)]
    motion, limits = config.motion, config.limits
    home = np.array(motion.home_q)
    try:
        check_poses(home[None], 0.0, obstacles(config), config, "motion.home_q", config.gripper.tip_clearance_m)
    except UnsafeMotion as error:
        problems.append(str(error))
    eye, space = config.camera.pose()[:3, 3], config.workspace
    if blocks_view(home, eye, space.x, space.y, config.table.height_m):
        problems.append("motion.home_q: the arm would stand between the camera and the workspace")
    z = config.table.height_m + motion.approach_m
    corners = {f"workspace, corner x {x}, y {y}": (x, y) for x, y in product(config.workspace.x, config.workspace.y)}
    for name, (x, y) in {**corners, "bin.center": config.bin.center}.items():
        if outside_box(np.array([[x, y, z]]), config, _ROUNDING_M, config.gripper.tip_clearance_m)[0]:
            problems.append(f"{name}: {1000 * motion.approach_m:.0f} mm above it the tcp would leave its limits")
            continue
        q = ur5e.inverse(flange_pose(tool_down(x, y, z, 0.0)), home)
        if q is None:
            problems.append(f"{name}: out of the arm's reach with the tool down")
            continue
        if motion.joint_speed_rad_s > limits.joint_speed_rad_s:
            continue
        way = JointMove(name, q, motion.joint_speed_rad_s, motion.joint_acceleration_rad_s2)
        try:
            joint_path(home, way, config, f"the way from motion.home_q to {name}")
        except UnsafeMotion as error:
            problems.append(str(error))
    if problems:
        heading = f"the configuration does not fit together: {len(problems)} problem(s)"
        raise ConfigError("\n  ".join([heading, *problems]))


def _over_limits(config: CellConfig) -> Iterator[str]:
    """Speeds over their limits, and forces at which the guard would stop the cell before a motion ends by itself."""
    motion, limits = config.motion, config.limits
    for name, limit in (
        ("joint_speed_rad_s", "joint_speed_rad_s"),
        ("linear_speed_m_s", "tool_speed_m_s"),
        ("guarded_speed_m_s", "tool_speed_m_s"),
        ("contact_force_n", "force_n"),
        ("closing_force_n", "grip_force_n"),
    ):
        value, most = getattr(motion, name), getattr(limits, limit)
        if value > most:
            yield f"motion.{name} = {value}: above limits.{limit} = {most}"
