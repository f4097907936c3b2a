"""Hardware control of a UR5e, RG2 and D415 pick cell.

What a program needs of it:

    import robotcell

    config = robotcell.load_config()          # the twin; or load_config(Path("cell.toml"))
    with robotcell.open_cell(config) as cell:
        view = cell.look()                    # frame, heightmap, objects
        cell.move(joints=config.motion.home_q)
        cell.grip(0.05)

Each name is imported when it is first used, so that `import robotcell` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robotcell.cell import Cell
    from robotcell.config import CellConfig, load_config
    from robotcell.errors import (
        CalibrationError,
        CellError,
        ConfigError,
        ConnectionLost,
        DeviceFault,
        GuardTripped,
        NoTarget,
        StorageError,
        UnsafeMotion,
    )
    from robotcell.interfaces import Arm, ArmState, Camera, Clock, Devices, Gripper, GripperState, RgbdFrame
    from robotcell.jobs.job import Report, run_job
    from robotcell.jobs.journal import Journal
    from robotcell.jobs.opening import open_cell
    from robotcell.jobs.policy_api import Action, Observation, PickAny, PickGoal, Policy, Uncover
    from robotcell.motion.executor import Ending, Execution
    from robotcell.motion.grasp import Grasp
    from robotcell.motion.push import Push
    from robotcell.perception.view import View

_PLACES = {
    "robotcell.cell": ("Cell",),
    "robotcell.config": ("CellConfig", "load_config"),
    "robotcell.errors": (
        "CalibrationError",
        "CellError",
        "ConfigError",
        "ConnectionLost",
        "DeviceFault",
        "GuardTripped",
        "NoTarget",
        "StorageError",
        "UnsafeMotion",
    ),
    "robotcell.interfaces": ("Arm", "ArmState", "Camera", "Clock", "Devices", "Gripper", "GripperState", "RgbdFrame"),
    "robotcell.jobs.job": ("Report", "run_job"),
    "robotcell.jobs.journal": ("Journal",),
    "robotcell.jobs.opening": ("open_cell",),
    "robotcell.jobs.policy_api": ("Action", "Observation", "PickAny", "PickGoal", "Policy", "Uncover"),
    "robotcell.motion.executor": ("Ending", "Execution"),
    "robotcell.motion.grasp": ("Grasp",),
    "robotcell.motion.push": ("Push",),
    "robotcell.perception.view": ("View",),
}
_PLACE_OF = {name: module for module, names in _PLACES.items() for name in names}

__all__ = [
    "Action",
    "Arm",
    "ArmState",
    "CalibrationError",
    "Camera",
    "Cell",
    "CellConfig",
    "CellError",
    "Clock",
    "ConfigError",
    "ConnectionLost",
    "DeviceFault",
    "Devices",
    "Ending",
    "Execution",
    "Grasp",
    "Gripper",
    "GripperState",
    "GuardTripped",
    "Journal",
    "NoTarget",
    "Observation",
    "PickAny",
    "PickGoal",
    "Policy",
    "Push",
    "Report",
    "RgbdFrame",
    "StorageError",
    "Uncover",
    "UnsafeMotion",
    "View",
    "load_config",
    "open_cell",
    "run_job",
]


def __getattr__(name: str) -> Any:
    if name not in _PLACE_OF:
        raise AttributeError(f"module 'robotcell' has no attribute {name!r}")
    return getattr(import_module(_PLACE_OF[name]), name)


def __dir__() -> list[str]:
    return __all__
