"""`robotcell twin`: serves a simulated cell over the devices' own protocols, and gives it faults."""

from __future__ import annotations

import json
import signal
import socket
import time
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

from cli.console import progress, report_error, results
from robotcell.config import CellConfig, load_config
from robotcell.errors import CellError, ConfigError, ConnectionLost
from sim_twin.wire.cell import ServedCell, is_loopback

if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import FrameType

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


def run_serve(
    cell_file: Path | None,
    options: Mapping[str, Any],
    host: str,
    ports: Mapping[str, int | None],
    *,
    expose: bool,
) -> int:
    """Serve until SIGINT or SIGTERM; returns the exit code.

    Args:
        cell_file: TOML file of the cell; its backend may be any, its arrangement is what counts.
        options: of the twin, above those of the file.
        host: address on which everything listens.
        ports: `modbus_port`, `camera_port` and `control_port` of `ServedCell`.
        expose: `host` may be an address that others can reach.
    """
    try:
        if not expose and not is_loopback(host):
            raise ConfigError(
                f"{host} can be reached from other machines, and the twin asks nobody who they are: take an address "
                "such as 127.0.0.2, or say --expose"
            )
        config = as_twin(cell_file, options)
        served = ServedCell(config, host, **{name: port for name, port in ports.items() if port is not None})
        ending = _Ending()
        with progress().status("building the cell and starting its servers"):
            served.start()
        with served:
            if not is_loopback(host):
                progress().print(
                    Text(
                        f"WARNING: everybody who can reach {host} can drive this cell and look through its camera; "
                        "nothing asks for a password. Never on a network that you do not own.",
                        style="bold red",
                    )
                )
            _print_endpoints(served.endpoints)
            _watch(served, ending)
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
            _ask(control, {"clear": True})
        if words:
            fault: dict[str, Any] = dict(zip(("device", "channel", "kind", "what"), words, strict=False))
            _ask(control, {"inject": {**fault, "value": value}})
        if show:
            _print_faults(_ask(control, {"list": True}))
    except CellError as error:
        return report_error(error)
    return 0


def as_twin(cell_file: Path | None, options: Mapping[str, Any]) -> CellConfig:
    """The cell with the twin for its backend, whatever it was."""
    backend = load_config(cell_file).backend
    own = backend.options if backend.name == "twin" else {}
    return load_config(cell_file, {"backend.name": "twin", "backend.options": {**own, **options}})


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


def _watch(served: ServedCell, ending: _Ending) -> None:
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
                    line.update(_status(before, now, _clients(served.endpoints)))
                before = now


def _status(before: tuple[Any, Any], now: tuple[Any, Any], clients: Mapping[str, int]) -> str:
    (state_before, command_before), (state, command) = before, now
    seconds = max(float(state["wall"] - state_before["wall"]), 1e-9)
    factor = float(state["t"] - state_before["t"]) / seconds
    rate = float(command["tick"] - command_before["tick"]) / seconds
    connected = ", ".join(f"{count} {name}" for name, count in clients.items() if count) or "none"
    left_out = int(state["skipped"])
    return f"real time x {factor:.3f}, {left_out} steps left out; controller {rate:.0f} Hz; clients: {connected}"


def _clients(endpoints: Mapping[str, str]) -> dict[str, int]:
    """How many connections each endpoint has, where the system tells."""
    try:
        rows = [row.split() for row in Path("/proc/net/tcp").read_text(encoding="ascii").splitlines()[1:]]
    except OSError:
        return {}
    established = [row[1] for row in rows if row[3] == "01"]
    counts = {}
    for name, address in endpoints.items():
        host, _, port = address.rpartition(":")
        # The kernel writes the address in its own byte order, here that of a little-endian machine.
        local = f"{socket.inet_aton(socket.gethostbyname(host))[::-1].hex().upper()}:{int(port):04X}"
        counts[name] = established.count(local)
    return counts


def _ask(control: str, request: dict[str, Any]) -> dict[str, Any]:
    host, _, port = control.rpartition(":")
    if not host or not port.isdecimal():
        raise ConfigError(f"--control {control!r}: give the address that `robotcell twin serve` prints, host:port")
    try:
        with socket.create_connection((host, int(port)), timeout=2) as link, link.makefile("rw") as lines:
            lines.write(json.dumps(request) + "\n")
            lines.flush()
            answer: dict[str, Any] = json.loads(lines.readline())
    except (OSError, ValueError) as error:
        raise ConnectionLost(
            f"no control socket answers at {control} ({error}): start `robotcell twin serve` with --control-port"
        ) from error
    if not answer["ok"]:
        raise ConfigError(answer["error"])
    return answer


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
