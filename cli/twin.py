"""`robotcell twin`: serves a simulated cell over the devices' own protocols, and gives it faults."""

from __future__ import annotations

import signal
import time
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

from cli.console import progress, report_error, results
from robotcell.errors import CellError, ConfigError, ConnectionLost
from sim_twin.wire.cell import ServedCell
from sim_twin.wire.control import ControlSocket
from sim_twin.wire.control_client import ask
from sim_twin.wire.exposure import check_exposure, is_loopback
from sim_twin.wire.monitor import Pace, connected_clients, pace
from sim_twin.wire.twin_config import load_as_twin

if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import FrameType

    from cli.options import CellChoice

# What each endpoint is for.
_USES = {
    "rtde": ("UR5e", "RTDE: state, and motion by ur_rtde"),
    "dashboard": ("UR5e", "dashboard: power, brakes, stops, programs"),
    "script": ("UR5e", "URScript programs, and the realtime state stream"),
    "primary": ("UR5e", "primary interface: state stream"),
    "secondary": ("UR5e", "secondary interface: state stream"),
    "primary read-only": ("UR5e", "primary interface, no programs"),
    "secondary read-only": ("UR5e", "secondary interface, no programs"),
    "realtime read-only": ("UR5e", "realtime state stream, no programs"),
    "modbus": ("RG2", "Modbus TCP of the Compute Box, unit 65; one client at a time"),
    "camera": ("D415", 'frames; camera.source = "twin://{}"'),
    "control": ("cell", "control socket: faults, JSON lines; robotcell twin fault"),
}
_STATUS_S = 1.0
# A signal is noticed after this.
_SIGNAL_S = 0.05
_TWICE_S = 1.0


@dataclass(frozen=True)
class Ports:
    """Where the parts of a served cell listen: ports of the Compute Box, the camera and the control socket.

    0 stands for any; a control socket is there only when it has a port.
    """

    modbus: int
    camera: int
    control: int | None


def run_serve(choice: CellChoice, host: str, ports: Ports, *, expose: bool) -> int:
    """Serve until SIGINT or SIGTERM; returns the exit code.

    Args:
        choice: the cell; its backend may be any, its arrangement is what counts.
        host: address on which everything listens.
        ports: there.
        expose: `host` may be an address that others can reach.
    """
    try:
        check_exposure(host, expose=expose)
        config = load_as_twin(choice.file, *choice.overrides())
        served = ServedCell(config, host, ports.modbus, ports.camera)
        ending = _Ending()
        with progress().status("building the cell and starting its servers"):
            served.start()
        with ExitStack() as open_parts:
            open_parts.enter_context(served)
            endpoints = dict(served.endpoints)
            if ports.control is not None:
                control = open_parts.enter_context(ControlSocket(served, host, ports.control))
                endpoints["control"] = control.endpoint
            if not is_loopback(host):
                progress().print(
                    Text(
                        f"WARNING: everybody who can reach {host} can drive this cell and look through its camera; "
                        "nothing asks for a password. Never on a network that you do not own.",
                        style="bold red",
                    )
                )
            _print_endpoints(endpoints)
            _watch(served, endpoints, ending)
    except CellError as error:
        return report_error(error)
    return 0


def run_fault(words: list[str], value: float | None, control: str, *, clear: bool, show: bool) -> int:
    """Talk to the control socket of a served cell; returns the exit code.

    Args:
        words: device, channel, kind and, where there are several, which.
        value: of the fault.
        control: "host:port" of the control socket.
        clear: end all faults first.
        show: list what exists and what is on.
    """
    try:
        if not (words or clear or show) or len(words) not in (0, 3, 4):
            raise ConfigError("say DEVICE CHANNEL KIND [WHAT] (gripper modbus stuck), or --clear, or --list")
        if clear:
            ask(control, {"clear": True})
        if words:
            fault: dict[str, Any] = dict(zip(("device", "channel", "kind", "what"), words, strict=False))
            ask(control, {"inject": {**fault, "value": value}})
        if show:
            _print_faults(ask(control, {"list": True}))
    except CellError as error:
        return report_error(error)
    return 0


class _Ending:
    """Whether SIGINT or SIGTERM came since this was made; one that comes a second later interrupts at once.

    A plain flag: a signal that comes while the handler of another one runs must find no lock. Some programs
    (`timeout`, a shell that ends a group) send two at a time.
    """

    def __init__(self) -> None:
        self.asked = False
        self._asked_at = 0.0
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._ask)

    def wait(self, seconds: float) -> bool:
        """Wait until a signal comes, but not much longer than so many seconds; whether one came."""
        end = time.monotonic() + seconds
        while not self.asked and time.monotonic() < end:
            time.sleep(_SIGNAL_S)
        return self.asked

    def _ask(self, _number: int, _frame: FrameType | None) -> None:
        if self.asked and time.monotonic() - self._asked_at > _TWICE_S:
            raise KeyboardInterrupt
        if not self.asked:
            self._asked_at = time.monotonic()
            self.asked = True


def _print_endpoints(endpoints: Mapping[str, str]) -> None:
    table = Table("device", "what", "address", box=None, pad_edge=False)
    for name, address in endpoints.items():
        device, what = _USES[name]
        table.add_row(device, Text(what.format(address)), address)
    results().print(table)


def _watch(served: ServedCell, endpoints: Mapping[str, str], ending: _Ending) -> None:
    """Show how it goes, until it is to end or a server dies."""
    console = progress()
    before = None
    status = console.status("serving; Ctrl-C ends it", refresh_per_second=2)
    with status if console.is_terminal else nullcontext() as line:
        while not ending.wait(_STATUS_S):
            if served.ended:
                raise ConnectionLost(f"the twin's process {' and '.join(served.ended)} has died: start it again")
            if line is not None:
                now = served.state(), served.command()
                if before is not None:
                    line.update(_status(pace(before, now), connected_clients(endpoints)))
                before = now


def _status(kept: Pace, clients: Mapping[str, int]) -> str:
    connected = ", ".join(f"{count} {name}" for name, count in clients.items() if count) or "none"
    return (
        f"real time x {kept.real_time_factor:.3f}, {kept.skipped} steps left out; controller "
        f"{kept.controller_hz:.0f} Hz; clients: {connected}"
    )


def _print_faults(answer: dict[str, Any]) -> None:
    table = Table("device", "fault", box=None, pad_edge=False)
    for device, names in answer["exist"].items():
        for name in names:
            table.add_row(device, name)
    out = results()
    out.print(table)
    for fault in answer["active"]:
        shown = " ".join(str(word) for word in fault.values() if word not in ("", None))
        out.print(Text(f"on: {shown}", style="bold"))
