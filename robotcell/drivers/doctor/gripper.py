"""The doctor's look at the gripper."""

from __future__ import annotations

import statistics
import time
from typing import TYPE_CHECKING

from robotcell.config.fingers import finger_problems, with_tips
from robotcell.drivers.clock import WallClock
from robotcell.drivers.doctor.timing import milliseconds
from robotcell.drivers.rg2 import RG2
from robotcell.findings import Finding, Grade

if TYPE_CHECKING:
    from collections.abc import Iterator

    from robotcell.config import CellConfig
    from robotcell.drivers.rg2 import RG2Options

_PERIOD_S = 0.02
_MAX_ANSWER_S = 0.05


def examine_gripper(options: RG2Options, config: CellConfig, seconds: float) -> Iterator[Finding]:
    """Connect to the gripper, hold its finger tips against the cell's file, and time its answers for `seconds`.

    Raises:
        CellError: as `RG2.connect` and `RG2.state`.
    """
    clock = WallClock()
    with RG2(options, clock) as gripper:
        yield Finding("gripper", "Compute Box", f"{options.host}:{options.port}, unit {options.unit}")
        yield Finding("gripper", "RG2", f"firmware {gripper.firmware()}")
        state = gripper.state()
        yield Finding("gripper", "state", f"{1000 * state.width_m:.1f} mm, {'busy' if state.busy else 'at rest'}")
        reach = gripper.range()
        widths = f"{1000 * reach.min_width_m:.0f} to {1000 * reach.max_width_m:.0f} mm{with_tips(reach)}"
        problems = finger_problems(config, reach)
        yield Finding("gripper", "fingers", widths, Grade.WRONG if problems else Grade.OK, "; ".join(problems))
        took: list[float] = []
        end = time.monotonic() + seconds
        while not took or time.monotonic() < end:
            begin = time.monotonic()
            gripper.state()
            took.append(time.monotonic() - begin)
            clock.sleep(_PERIOD_S)
    slow = statistics.median(took) > _MAX_ANSWER_S
    yield Finding(
        "gripper",
        "Modbus",
        f"answers in {milliseconds(took)}",
        Grade.WRONG if slow else Grade.OK,
        "use a cable straight to the Compute Box" if slow else "",
    )
