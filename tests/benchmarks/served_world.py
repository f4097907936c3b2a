"""What a served cell costs: `python -m tests.benchmarks.served_world`.

For 10 and for 30 objects: real-time factor, steps left out, rate of the controller and share of a core of each process,
while the arm ploughs through the objects and the gripper is polled at 125 Hz and never rests; then how many states of
the gripper can be read in a second. Targets on two free cores: a real-time factor of 1, no step left out, 500 Hz.
"""

import socket
import sys
import time

import numpy as np
import psutil

from robotcell.config import load_config
from robotcell.drivers.clock import WallClock
from robotcell.drivers.rg2 import RG2, RG2Options
from robotcell.geometry import rg2, ur5e
from robotcell.geometry.transforms import invert_transform, make_transform
from sim_twin.wire.cell import ServedCell

HOST = "127.0.0.21"
SETTLE_S = 3.0
MEASURE_S = 10.0
READ_S = 2.0
POLL_S = 0.008


def plough(address: str) -> None:
    """Send the controller a program: furrows 30 mm above the table, to and fro, for longer than is measured."""
    q = np.array(load_config().motion.home_q)
    corners = []
    for x, y in [(x, side * 0.15) for x in (-0.58, -0.54, -0.5, -0.46, -0.42) for side in (-1, 1)]:
        tool_down = make_transform(np.diag([1.0, -1.0, -1.0]), (x, y, 0.03))
        near = ur5e.inverse(tool_down @ invert_transform(rg2.T_FLANGE_TCP), q)
        assert near is not None
        q = near
        corners.append(q)
    moves = [f"  movej({corner.tolist()}, a=1.4, v=0.5)" for corner in corners * 3]
    host, _, port = address.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=5) as script:
        script.sendall("\n".join(["def plough():", *moves, "end", ""]).encode())
        # Until the controller has it.
        time.sleep(SETTLE_S)


def measure(objects: int) -> str:
    """One line for a number of objects."""
    config = load_config(None, {"backend.options.objects": objects})
    with ServedCell(config, HOST, modbus_port=0, camera_port=0) as cell:
        options = RG2Options(host=HOST, port=int(cell.endpoints["modbus"].rpartition(":")[2]))
        with RG2(options, WallClock()) as gripper:
            processes = {name: psutil.Process(pid) for name, pid in cell.processes.items()}
            plough(cell.endpoints["script"])
            for process in processes.values():
                process.cpu_percent()
            state, command = cell.state(), cell.command()
            end, widths = time.monotonic() + MEASURE_S, (0.02, 0.1)
            while time.monotonic() < end:
                if not gripper.state().busy:
                    gripper.start_width(widths[0], 20.0)
                    widths = widths[::-1]
                time.sleep(POLL_S)
            after, commanded = cell.state(), cell.command()
            shares = ", ".join(f"{name} {process.cpu_percent():.0f} %" for name, process in processes.items())
            seconds = after["wall"] - state["wall"]
            reads, end = 0, time.monotonic() + READ_S
            while time.monotonic() < end:
                gripper.state()
                reads += 1
    return (
        f"{objects} objects: real time x {(after['t'] - state['t']) / seconds:.4f}, "
        f"{after['skipped'] - state['skipped']} steps left out, "
        f"controller {(commanded['tick'] - command['tick']) / seconds:.1f} Hz; of one core: {shares}; "
        f"{reads / READ_S:.0f} gripper states/s\n"
    )


def main() -> None:
    """Print a line for each number of objects."""
    for objects in (10, 30):
        sys.stdout.write(measure(objects))


if __name__ == "__main__":
    main()
