"""What the served camera reaches: `python -m tests.benchmarks.served_camera`.

Ten objects, the arm at home. Frames a second and their age at a client, with nothing moving and with one object that is
moved before each frame; the parts of a frame; and how long `read()` of the driver takes and how old its frames are.
"""

import os
import sys
import time

import numpy as np

from robotcell.config import load_config
from robotcell.drivers.clock import WallClock
from robotcell.drivers.d415.camera import D415, D415Options
from sim_twin.d415.renderer import MODES, Renderer
from sim_twin.options import TwinOptions
from sim_twin.wire.d415.stream import Frame, Image, encode
from sim_twin.world.world import World
from tests.sim_twin.wire.d415.served_camera import RawClient, ServedCamera

SECONDS = 5.0
ROUNDS = 15
OBJECT = -1


def ten_objects():
    """Visuals and poses of the default scene."""
    world = World(load_config(), TwinOptions())
    world.attach(ten_objects)
    try:
        return world.visuals(), world.visual_poses()
    finally:
        world.close()


def parts(served, resolution):
    """Median milliseconds of the steps of a frame."""
    mount = served.config.camera.model_copy(update={"resolution": resolution})
    renderer = Renderer(served.visuals, mount, TwinOptions())
    taken = {name: [] for name in ("rays", "shading", "depth noise", "colour noise", "encoding")}

    def timed(name, do, *arguments):
        begun = time.perf_counter()
        result = do(*arguments)
        taken[name].append((time.perf_counter() - begun) * 1000)
        return result

    for number in range(ROUNDS):
        hits = timed("rays", renderer.cast, served.poses)
        color, cos = timed("shading", lambda h=hits: (renderer.color(h), renderer.incidence_cos(h)))
        depth_m = timed("depth noise", renderer.measured_depth, hits.depth_m, cos, number)
        noisy = timed("colour noise", renderer.measured_color, color, number, 0.0, number)
        frame = Frame(Image(number, 0.0, (depth_m * 1000).astype(np.uint16)), Image(number, 0.0, noisy))
        timed("encoding", encode, frame)
    return {name: float(np.median(values)) for name, values in taken.items()}


def rate(served, resolution, moving):
    """Frames a second at a client, and the median age of a frame when it is there [ms]."""
    ages = []
    with RawClient(served, resolution) as client:
        client.frame()
        begun = time.monotonic()
        while time.monotonic() < begun + SECONDS:
            frame = client.frame()
            ages.append((time.time() - frame.depth.t) * 1000)
            if moving:
                served.move(OBJECT, (0.0, 0.0, 0.001 * (-1) ** len(ages)))
    return len(ages) / SECONDS, float(np.median(ages))


def driver(served, resolution):
    """Median milliseconds that `read()` takes, and the median and greatest age of a frame that it returns."""
    mount = served.config.camera.model_copy(update={"resolution": resolution})
    reads, ages = [], []
    with D415(D415Options(source=served.source), mount, WallClock()) as camera:
        for _ in range(3 * ROUNDS):
            begun = time.monotonic()
            frame = camera.read()
            reads.append((time.monotonic() - begun) * 1000)
            ages.append((time.monotonic() - frame.t) * 1000)
    return float(np.median(reads)), float(np.median(ages)), max(ages)


def main() -> None:
    """Print the figures."""
    say = sys.stdout.write
    with ServedCamera("127.0.0.39", scene=ten_objects()) as served:
        for resolution in sorted(MODES, reverse=True):
            say(f"{resolution}, load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors\n")
            for name, value in parts(served, resolution).items():
                say(f"  {name:14s}{value:6.1f} ms\n")
            for words, moving in (("nothing moves", False), ("moving", True)):
                frames_per_s, age_ms = rate(served, resolution, moving)
                say(f"  {words:14s}{frames_per_s:6.1f} frames/s, {age_ms:.0f} ms old at the client\n")
            read_ms, age_ms, oldest_ms = driver(served, resolution)
            say(f"  driver        read() {read_ms:.0f} ms; frames {age_ms:.0f} ms old, at most {oldest_ms:.0f} ms\n")


if __name__ == "__main__":
    main()
