"""Looks at every device of a hardware cell at once and says what is wrong. Never moves anything.

Each device is examined by its driver's own means, so that what the doctor accepts a job can open.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from robotcell.drivers.backend import HardwareOptions
from robotcell.drivers.doctor.arm import examine_arm
from robotcell.drivers.doctor.camera import examine_calibration, examine_camera
from robotcell.drivers.doctor.computer import examine_computer
from robotcell.drivers.doctor.gripper import examine_gripper
from robotcell.errors import ConfigError
from robotcell.findings import Finding, collect

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from robotcell.config import CellConfig


def examine(config: CellConfig, seconds: float) -> list[Finding]:
    """Examine the cell of a configuration, all devices at once.

    Args:
        config: of the backend `hardware`.
        seconds: how long latencies are measured.

    Raises:
        ConfigError: its backend is another one.
    """
    if config.backend.name != "hardware":
        raise ConfigError(
            f"the doctor examines cells of the backend 'hardware', and this one's is {config.backend.name!r}: give a "
            "cell file such as examples/hardware.toml by --cell"
        )
    options = HardwareOptions.model_validate(config.backend.options)
    rounds: list[tuple[str, Callable[[], Iterator[Finding]]]] = [
        ("computer", lambda: examine_computer(options.camera.source)),
        ("arm", lambda: examine_arm(options.arm, seconds, config.limits.state_age_s)),
        ("gripper", lambda: examine_gripper(options.gripper, config, seconds)),
        ("camera", lambda: examine_camera(options.camera, config.camera, seconds)),
        ("calibration", lambda: examine_calibration(config.camera)),
    ]
    with ThreadPoolExecutor(len(rounds)) as pool:
        return [finding for found in pool.map(lambda args: collect(*args), rounds) for finding in found]
