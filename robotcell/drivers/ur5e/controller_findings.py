"""What is found of a controller: for the doctor before it is connected, for a job's preflight afterwards."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from robotcell.drivers.ur5e.controller import obstacles
from robotcell.findings import Finding, Grade
from robotcell.geometry import rg2
from robotcell.geometry.transforms import matrix_to_rotvec

if TYPE_CHECKING:
    from collections.abc import Iterator

    from robotcell.drivers.ur5e.controller import Controller

# Pose (6,) [m, rad] of the tool centre point on the flange, as the driver sets it.
TCP_OFFSET = (*rg2.T_FLANGE_TCP[:3, 3].tolist(), *matrix_to_rotvec(rg2.T_FLANGE_TCP[:3, :3]).tolist())
_TCP_TOLERANCE = 1e-4
_PAYLOAD_TOLERANCE_KG = 1e-3
_COG_TOLERANCE_M = 1e-3


def controller_findings(controller: Controller) -> Iterator[Finding]:
    """Who it is, and whether it can be driven."""
    yield Finding("arm", "PolyScope", ".".join(map(str, controller.version)))
    yield Finding("arm", "model, serial", f"{controller.model}, {controller.serial}")
    yield Finding("arm", "remote control", "on" if controller.remote else "off")
    slow = controller.speed_fraction < 1.0
    yield Finding(
        "arm",
        "speed slider",
        f"{100 * controller.speed_fraction:.0f} %",
        Grade.NOTE if slow else Grade.OK,
        "every motion is so much slower: move it up at the pendant" if slow else "",
    )
    for cure in obstacles(controller):
        yield Finding("arm", "ready", "no", Grade.WRONG, cure)
    if controller.protective_stop:
        yield Finding("arm", "safety", "protective stop", Grade.WRONG, "look at the cell, then robotcell recover")


def tool_findings(
    controller: Controller, payload_kg: float, payload_cog: tuple[float, ...], *, changed: bool
) -> Iterator[Finding]:
    """The tool that the controller reckons with, against the cell's.

    Args:
        controller: as it answered.
        payload_kg: of the cell's file.
        payload_cog: (3,) [m] of the cell's file.
        changed: whether the driver has set the cell's, so that somebody else changed what differs.
    """
    found = (
        ("TCP [m, rad]", controller.tcp_offset, TCP_OFFSET, _TCP_TOLERANCE),
        ("payload [kg]", (controller.payload_kg,), (payload_kg,), _PAYLOAD_TOLERANCE_KG),
        ("payload's centre [m]", controller.payload_cog, payload_cog, _COG_TOLERANCE_M),
    )
    for what, value, wanted, tolerance in found:
        if np.allclose(value, wanted, atol=tolerance):
            yield Finding("arm", what, _numbers(value))
        elif changed:
            cure = f"the cell's is {_numbers(wanted)}, and somebody has changed it: close the cell and open it again"
            yield Finding("arm", what, _numbers(value), Grade.WRONG, cure)
        else:
            cure = (
                f"the cell's is {_numbers(wanted)}: it is set at connect; enter it in the installation too, for "
                "jogging and freedrive"
            )
            yield Finding("arm", what, _numbers(value), Grade.NOTE, cure)


def _numbers(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:.4g}" for value in values)
