"""How well the served UR controller keeps its 500 Hz. Run it: python -m tests.benchmarks.wire_rate [seconds] [flood].

The arm is a perfect one, so this is the server alone; `wire_cell` measures the whole cell.
Three clients: one reads every variable but the registers and does the timing, one only reads the time, and one sends
servo commands to the control loop at 500 Hz. With `flood`, a fourth sends one program of a megabyte after another.
"""

from __future__ import annotations

import contextlib
import os
import socket
import sys
import threading
import time

import numpy as np
import psutil

from sim_twin.wire.ur.variables import OUTPUTS
from tests.sim_twin.wire.ur.control_script import CONTROL_SCRIPT
from tests.sim_twin.wire.ur.rtde_client import RtdeClient, reading
from tests.sim_twin.wire.ur.stub_world import START_Q, ServedController

_HOST = "127.0.0.18"
_NAMES = [name for name in OUTPUTS if "register" not in name]
_SERVO = 11


def _servo(ended: threading.Event) -> None:
    """Run the control script and move the base to and fro by servo commands."""
    names = ["input_int_register_0", *(f"input_double_register_{i}" for i in range(11))]
    with RtdeClient(_HOST) as client, socket.create_connection((_HOST, 30003), timeout=2) as script:
        client.negotiate()
        recipe, _ = client.inputs(names)
        script.sendall(CONTROL_SCRIPT)
        begin = deadline = time.monotonic()
        while not ended.is_set():
            t = time.monotonic() - begin
            q = (START_Q[0] + 0.2 * np.sin(t), *START_Q[1:])
            client.write(recipe, _SERVO, *q, 0.5, 0.5, 0.002, 0.1, 300.0)
            deadline += 0.002
            time.sleep(max(0.0, deadline - time.monotonic()))


def _flood(ended: threading.Event) -> None:
    """Send programs that take long to read; each is refused at its end, and the control loop goes on."""
    move = b"  movej([0,-1.57,1.57,-1.57,-1.57,0], a=1.4, v=1.0)\n"
    program = b"sec large():\n" + move * (1_000_000 // len(move)) + b"end\n"
    with socket.create_connection((_HOST, 30001), timeout=0.1) as client:
        while not ended.is_set():
            left = memoryview(program)
            while left and not ended.is_set():
                with contextlib.suppress(TimeoutError):
                    left = left[client.send(left) :]


def main(seconds: float, *, flood: bool) -> None:
    """Measure and print."""
    with ServedController(_HOST) as served, reading(_HOST, *_NAMES) as reader, reading(_HOST, "timestamp"):
        ended = threading.Event()
        threads = [threading.Thread(target=act, args=(ended,)) for act in (_servo, *([_flood] if flood else []))]
        for thread in threads:
            thread.start()
        process = psutil.Process(served.process.pid)
        # The served cell gives its controller this priority; here the one who measures has it too.
        for pid in (process.pid, 0):
            with contextlib.suppress(OSError):
                os.sched_setscheduler(pid, os.SCHED_RR, os.sched_param(1))
        for _ in range(250):
            reader.package()
        process.cpu_percent()
        arrivals, stamps, execution = [], [], []
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            package = reader.package()
            arrivals.append(time.monotonic())
            stamps.append(package["timestamp"])
            execution.append(package["actual_execution_time"])
        cpu = process.cpu_percent()
        ended.set()
        for thread in threads:
            thread.join()
    t, stamp = np.array(arrivals), np.array(stamps, dtype=np.float64)
    # The least late package sets the origin.
    late = (t - stamp) - (t - stamp).min()
    lines = (
        f"rate        {(len(t) - 1) / (t[-1] - t[0]):.2f} Hz over {t[-1] - t[0]:.1f} s",
        f"left out    {round((stamp[-1] - stamp[0]) / 0.002) - (len(t) - 1)} periods",
        "lateness    p50 {:.2f}, p99 {:.2f}, max {:.2f} ms".format(*(np.percentile(late, [50, 99, 100]) * 1e3)),
        "one period  p50 {:.2f}, p99 {:.2f}, max {:.2f} ms".format(*(np.percentile(execution, [50, 99, 100]) * 1e3)),
        f"processor   {cpu:.0f} % of a core",
    )
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0, flood="flood" in sys.argv)
