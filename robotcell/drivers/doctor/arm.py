"""The doctor's look at the arm."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from robotcell.drivers.doctor.timing import milliseconds
from robotcell.drivers.ur5e.controller import IN_USE_CURE, inputs_in_use, inspect, program_held
from robotcell.drivers.ur5e.controller_findings import controller_findings, tool_findings
from robotcell.drivers.ur5e.dashboard import Dashboard
from robotcell.drivers.ur5e.rtde import as_number, open_rtde
from robotcell.findings import Finding, Grade

if TYPE_CHECKING:
    from collections.abc import Iterator

    from robotcell.drivers.ur5e.arm import UR5eOptions

_RTDE_HZ = 125.0
_MIN_RATE = 0.95
_DASHBOARD_ASKS = 20
# The inputs that ur_rtde takes.
_INPUTS = (*(f"input_int_register_{i}" for i in range(8)), *(f"input_double_register_{i}" for i in range(18)))
_LINK_ADVICE = (
    "use a cable straight to the controller, or a switch of its own, no Wi-Fi or office network; less load on this "
    "computer"
)


def examine_arm(options: UR5eOptions, seconds: float, state_age_s: float) -> Iterator[Finding]:
    """Watch the arm; control is not taken, since that would start a program on it.

    Args:
        options: where it is, and what its tool weighs.
        seconds: how long its data are timed.
        state_age_s: of a state, at which the safety layer stops motions.

    Raises:
        ConnectionLost: it cannot be reached, or answers no longer.
    """
    controller = inspect(options.host)
    yield from controller_findings(controller)
    held = program_held(controller.runtime_state)
    yield Finding("arm", "program", held or "none runs", Grade.WRONG if held else Grade.OK, held)
    yield from tool_findings(controller, options.payload_kg, options.payload_cog, changed=False)
    in_use = inputs_in_use(options.host, _INPUTS)
    yield Finding(
        "arm",
        "RTDE inputs",
        f"{len(in_use)} in use" if in_use else "free",
        Grade.WRONG if in_use else Grade.OK,
        f"{', '.join(in_use)}: {IN_USE_CURE}" if in_use else "",
    )
    yield from _time_rtde(options.host, seconds, state_age_s)
    yield _time_dashboard(options.host)


def _time_rtde(host: str, seconds: float, state_age_s: float) -> Iterator[Finding]:
    """Rate and lateness of the controller's data; beyond the age that the safety layer allows, motions are stopped."""
    stamps: list[float] = []
    arrivals: list[float] = []
    with open_rtde(host) as rtde:
        rtde.start(["timestamp"], _RTDE_HZ)
        end = time.monotonic() + seconds
        while not arrivals or arrivals[-1] < end:
            stamps.append(as_number(rtde.read()["timestamp"]))
            arrivals.append(time.monotonic())
    stamp, arrival = np.array(stamps, dtype=np.float64), np.array(arrivals)
    rate = (len(stamp) - 1) / (arrival[-1] - arrival[0]) if len(stamp) > 1 else 0.0
    gap = float(np.diff(arrival).max()) if len(stamp) > 1 else seconds
    late_ms = 1000 * (arrival - stamp - (arrival - stamp).min())
    grade = Grade.OK
    if rate < _MIN_RATE * _RTDE_HZ or gap > state_age_s:
        grade = Grade.WRONG
    elif gap > state_age_s / 2:
        grade = Grade.NOTE
    yield Finding(
        "arm",
        "RTDE",
        f"{rate:.1f} Hz of {_RTDE_HZ:.0f}, longest gap {1000 * gap:.0f} ms, late by {np.median(late_ms):.1f} ms "
        f"(99 %: {np.percentile(late_ms, 99):.1f} ms)",
        grade,
        "" if grade is Grade.OK else _LINK_ADVICE,
    )


def _time_dashboard(host: str) -> Finding:
    dashboard = Dashboard(host)
    took: list[float] = []
    try:
        dashboard.connect()
        for _ in range(_DASHBOARD_ASKS):
            begin = time.monotonic()
            dashboard.ask("robotmode")
            took.append(time.monotonic() - begin)
    finally:
        dashboard.close()
    return Finding("arm", "dashboard", f"answers in {milliseconds(took)}")
