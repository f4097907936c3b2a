"""Jobs killed at random instants over the wire, and resumed: `python -m tests.benchmarks.killed_jobs`.

Each job picks everything in a served twin of its own. It is killed by SIGKILL so many times, each at a random instant
after it has started or gone on, and resumed; then the journal is held against the world: every object that lies in the
bin is counted once, and nothing else is. One line of JSON a job; a run that was cut off goes on where it was.
"""

from __future__ import annotations

import argparse
import json
import random
import subprocess
import sys
import time
from collections import Counter
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from robotcell.config import load_config
from robotcell.jobs.journal import Journal
from robotcell.perception.colors import PALETTE
from sim_twin.devices.backend import open_twin
from sim_twin.wire.cell import ServedCell
from sim_twin.wire.shared_state import Record, poses_dtype

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.config import CellConfig
    from sim_twin.visual import Visual

HOST, MODBUS_PORT, CAMERA_PORT = "127.0.0.53", 15053, 30453
PLACES = {"red": (0.05, 0.08), "blue": (-0.06, 0.09), "green": (0.06, -0.07), "yellow": (-0.05, -0.08)}
# A grasp and its way to the bin and home take 8 s; with this and the looks between, kills fall into all parts of a job.
LATEST_KILL_S = 20.0
LIMIT_S = 600.0
RECOVERIES = 5
# What a job ends with that robotcell recover must come before.
STOPPED = {"guard-tripped", "device-fault", "connection-lost"}


@dataclass(frozen=True)
class Killed:
    """What came of a job that was killed and resumed.

    Attributes:
        seed: of the instants.
        killed_after_s: when it was killed, each time after it had begun or gone on [s]; not when it had ended by then.
        in_bin: colours of the objects that lie in the bin.
        picked: colours that the journal counts.
        results: of the job's actions.
        completed: the job ended with everything picked.
        reason: why not.
    """

    seed: int
    killed_after_s: list[float]
    in_bin: list[str]
    picked: list[str]
    results: list[str]
    completed: bool
    reason: str

    @property
    def counted_once(self) -> bool:
        """Whether the journal counts what lies in the bin."""
        return Counter(self.in_bin) == Counter(self.picked)


def kill_and_resume(seed: int, kills: int, folder: Path, address: tuple[str, int, int]) -> Killed:
    """Serve a cell, run a job in it, kill it at random instants, resume it, and hold the journal against the world.

    Args:
        seed: of the instants.
        kills: how many.
        folder: new, for the files of the cell and of the job.
        address: host, and ports of the Compute Box and of the camera.
    """
    folder.mkdir(parents=True, exist_ok=True)
    twin, cell_file = _cells(folder, address)
    instants = random.Random(seed)
    after = [round(instants.uniform(0.0, LATEST_KILL_S), 2) for _ in range(kills)]
    visuals = _visuals(twin)
    with ServedCell(twin, *address) as served:
        command, killed = ["pick", "--all", "--policy", "heuristic"], []
        for kill_s in after:
            if _was_killed(_command(command, cell_file), kill_s):
                killed.append(kill_s)
            command = ["resume"]
        for recovered in range(RECOVERIES + 1):
            report = json.loads(_output(_command([*command, "--json"], cell_file)))
            if report["code"] not in STOPPED or recovered == RECOVERIES:
                break
            # A stop of the twin's own, as on a machine that is too busy for real time.
            _output(_command(["recover", "--yes"], cell_file))
        in_bin = _in_bin(served, twin, visuals)
    with Journal(load_config(cell_file).journal.database_url()) as journal:
        job = journal.job(1)
        picked = list(journal.metrics(job.id).picked)
    results = [row.outcome.result if row.outcome else "none" for row in job.actions]
    return Killed(seed, killed, sorted(in_bin), sorted(picked), results, job.status == "complete", job.reason)


def _cells(folder: Path, address: tuple[str, int, int]) -> tuple[CellConfig, Path]:
    """The twin that is served, and the file of the cell that drives it."""
    host, modbus_port, camera_port = address
    objects = "".join(
        f'[[object]]\nname = "{color}"\nshape = "cube"\ncolor = "{color}"\nposition = [{x}, {y}, 0.025]\n'
        for color, (x, y) in PLACES.items()
    )
    scene = folder / "scene.toml"
    scene.write_text(f'name = "four cubes"\n{objects}', encoding="utf-8")
    cell_file = folder / "cell.toml"
    cell_file.write_text(
        f'[backend]\nname = "hardware"\n[backend.options.arm]\nhost = "{host}"\n'
        f'[backend.options.gripper]\nhost = "{host}"\nport = {modbus_port}\n'
        f'[backend.options.camera]\nsource = "twin://{host}:{camera_port}"\n'
        f'[journal]\nruns = "{folder / "runs"}"\n',
        encoding="utf-8",
    )
    return load_config(None, {"backend.options.scene": str(scene)}), cell_file


def _command(words: Sequence[str], cell_file: Path) -> list[str]:
    return [sys.executable, "-c", "from cli.main import main; main()", *words, "--cell", str(cell_file)]


def _was_killed(command: list[str], kill_s: float) -> bool:
    """Run a command and kill it so long after its job has begun or gone on; False if it ended by itself before."""
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        if any(line.startswith("job ") for line in iter(process.stderr.readline, "")):
            with suppress(subprocess.TimeoutExpired):
                process.wait(kill_s)
        running = process.poll() is None
        process.kill()
        return running


def _output(command: list[str]) -> str:
    """What a command prints on stdout; nobody answers its questions."""
    return subprocess.run(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True, timeout=LIMIT_S, check=False
    ).stdout


def _visuals(twin: CellConfig) -> tuple[Visual, ...]:
    cell, world = open_twin(twin)
    with cell:
        return world.visuals()


def _in_bin(served: ServedCell, twin: CellConfig, visuals: tuple[Visual, ...]) -> list[str]:
    """Colours of the objects in the bin, by the world's own record."""
    poses = Record(poses_dtype(len(visuals)), served.shared_memory[-1])
    try:
        places = {visual.object_index: T for visual, T in zip(visuals, poses.read()["poses"], strict=True)}
    finally:
        poses.close()
    (cx, cy), (sx, sy) = twin.bin.center, twin.bin.size
    rim = twin.table.height_m + twin.bin.wall_height_m
    found = []
    for index, color in enumerate(PLACES):
        x, y, z = places[index][:3, 3]
        if abs(x - cx) < sx / 2 and abs(y - cy) < sy / 2 and z < rim:
            found.append(color)
    assert set(PLACES) <= set(PALETTE)
    return found


def main() -> None:
    """Run the jobs that are left, and print what came of each and of all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100, help="of jobs")
    parser.add_argument("--kills", type=int, default=1, help="of each job")
    parser.add_argument("--out", type=Path, default=Path("runs/killed-jobs"), help="folder of the runs")
    given = parser.parse_args()
    log = given.out / "jobs.jsonl"
    known = [Killed(**json.loads(line)) for line in log.read_text().splitlines()] if log.exists() else []
    done = {job.seed for job in known}
    for seed in range(given.count):
        if seed in done:
            continue
        folder = given.out / f"{seed}-{time.time():.0f}"
        job = kill_and_resume(seed, given.kills, folder, (HOST, MODBUS_PORT, CAMERA_PORT))
        known.append(job)
        with log.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(asdict(job)) + "\n")
        sys.stdout.write(f"{'once' if job.counted_once else 'WRONG'} {asdict(job)}\n")
        sys.stdout.flush()
    once, complete = sum(job.counted_once for job in known), sum(job.completed for job in known)
    kills = sum(len(job.killed_after_s) for job in known)
    sys.stdout.write(f"{len(known)} jobs, {kills} kills: {once} count every object once, {complete} are complete\n")


if __name__ == "__main__":
    main()
