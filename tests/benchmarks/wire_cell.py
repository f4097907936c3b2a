"""Moves, grips and frames in a row over the wire: errors and latencies. `python -m tests.benchmarks.wire_cell`."""

from __future__ import annotations

import argparse
import os
import sys
import time
from typing import TYPE_CHECKING

import numpy as np

from robotcell.cell import open_cell
from robotcell.config import load_config
from robotcell.drivers.ur5e.rtde import as_number, open_rtde
from robotcell.errors import CellError
from sim_twin.wire.cell import ServedCell

if TYPE_CHECKING:
    from robotcell.cell import Cell

HOST, MODBUS_PORT, CAMERA_PORT = "127.0.0.43", 15043, 30443
PERIOD_S = 0.008
TURN_RAD = 0.25
STOPS = 20
RTDE_S = 10.0


def main() -> None:
    """Serve a cell of ten objects, drive it, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200, help="of moves, grips and frames each")
    count = parser.parse_args().count
    twin = load_config(None, {"backend.name": "twin", "backend.options.objects": 10})
    config = load_config(
        None,
        {
            "backend.name": "hardware",
            "backend.options.arm.host": HOST,
            "backend.options.gripper.host": HOST,
            "backend.options.gripper.port": MODBUS_PORT,
            "backend.options.camera.source": f"twin://{HOST}:{CAMERA_PORT}",
        },
    )
    _say(f"load average before: {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")
    with ServedCell(twin, HOST, MODBUS_PORT, CAMERA_PORT) as served:
        with open_cell(config) as cell:
            latencies: list[float] = []
            begin = time.monotonic()
            errors = _work(cell, count, latencies)
            _say(f"{count} moves, grips and frames in {time.monotonic() - begin:.0f} s: {errors} errors")
            _say_ms("arm.state()", np.array(latencies))
            _measure_stops(cell, served)
        _measure_rtde()
        _say(f"load average after: {os.getloadavg()[0]:.1f}; ended processes: {served.ended or 'none'}")


def _work(cell: Cell, count: int, latencies: list[float]) -> int:
    home = np.array(cell.config.motion.home_q)
    errors = 0
    for i in range(count):
        try:
            if i % 2:
                T = cell.arm.state().T_base_tcp.copy()
                T[2, 3] += 0.03 if i % 4 == 1 else -0.03
                cell.arm.start_linear(T, 0.25, 1.2)
            else:
                cell.arm.start_joints(home + (TURN_RAD if i % 4 == 0 else 0.0) * np.eye(6)[5], 1.5, 4.0)
            _finish(cell, latencies)
            cell.gripper.start_width(0.04 if i % 2 else 0.08, 20.0)
            cell.clock.sleep(PERIOD_S)
            while cell.gripper.state().busy:
                cell.arm.kick()
                cell.clock.sleep(PERIOD_S)
            cell.camera.read()
        except CellError as error:
            errors += 1
            _say(f"{i}: {type(error).__name__}: {error}")
            cell.arm.connect()
            cell.gripper.connect()
            cell.camera.connect()
            cell.arm.recover()
    return errors


def _finish(cell: Cell, latencies: list[float]) -> None:
    while cell.arm.moving:
        begin = time.perf_counter()
        cell.arm.state()
        latencies.append(time.perf_counter() - begin)
        cell.arm.kick()
        cell.clock.sleep(PERIOD_S)


def _measure_stops(cell: Cell, served: ServedCell) -> None:
    """How long after the call the served arm brakes, and stands."""
    home = np.array(cell.config.motion.home_q)
    took, brakes, stands = [], [], []
    for i in range(STOPS):
        cell.arm.start_joints(home + (0.6 if i % 2 else -0.6) * np.eye(6)[5], 1.0, 4.0)
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            cell.arm.kick()
            cell.clock.sleep(PERIOD_S)
        speed = float(np.abs(served.state()["qd"]).max())
        begin = time.monotonic()
        cell.arm.stop()
        took.append(time.monotonic() - begin)
        braking = None
        while (now := served.state()) is not None:
            fast = float(np.abs(now["qd"]).max())
            if braking is None and fast < 0.9 * speed:
                braking = float(now["wall"]) - begin
            if fast < 0.02 or time.monotonic() - begin > 2.0:
                break
            time.sleep(0.001)
        brakes.append(braking if braking is not None else float("nan"))
        stands.append(time.monotonic() - begin)
        _finish(cell, [])
    _say_ms("arm.stop() returns", np.array(took))
    _say_ms("arm brakes after stop()", np.array(brakes))
    _say_ms("arm stands after stop()", np.array(stands))


def _measure_rtde() -> None:
    """The rate and the lateness of the server's 500 Hz stream."""
    stamps, arrivals = [], []
    with open_rtde(HOST) as rtde:
        rtde.start(["timestamp"], 500.0)
        end = time.monotonic() + RTDE_S
        while not arrivals or arrivals[-1] < end:
            stamps.append(as_number(rtde.read()["timestamp"]))
            arrivals.append(time.monotonic())
    stamp, arrival = np.array(stamps), np.array(arrivals)
    rate = (len(arrival) - 1) / (arrival[-1] - arrival[0])
    late = arrival - stamp
    _say(f"RTDE: {rate:.2f} Hz of 500, clock {(stamp[-1] - stamp[0]) / (arrival[-1] - arrival[0]):.5f} of real time")
    _say_ms("RTDE lateness", late - late.min())


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _say_ms(what: str, seconds: np.ndarray) -> None:
    median, p99, worst = 1000 * np.array([np.median(seconds), np.percentile(seconds, 99), seconds.max()])
    _say(f"{what}: median {median:.2f} ms, 99 % {p99:.2f} ms, worst {worst:.2f} ms of {len(seconds)}")


if __name__ == "__main__":
    main()
