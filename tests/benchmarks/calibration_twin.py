"""The whole calibration in the twin, for many seeds, against the simulator's truth.

    python -m tests.benchmarks.calibration_twin --seeds 20

Each seed has a camera that stands some centimetres and degrees from where the configuration has it, a board that is
held a little differently, and views of its own. The views are collected as `robotcell calibrate` collects them: through
the safety layer and the executor, with the default noise of the camera.

The twin's arm knows its own poses to a micrometre, which no arm does. `--arm-mm` and `--arm-mrad` disturb the recorded
flange poses by errors of that size (one standard deviation along and about each axis), view by view, before solving.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from calibration.collect.acquisition import collect
from calibration.collect.session import open_session, read_session
from calibration.solve.pipeline import solve
from calibration.solve.se3 import change, difference
from calibration.target.held_board import HeldBoard
from robotcell.config import load_config
from robotcell.errors import CellError
from robotcell.perception.board_plate import DEFAULT_BOARD, held_by_gripper
from sim_twin.devices.backend import open_twin
from sim_twin.options import TwinOptions

LIMIT_MM, LIMIT_DEG = 0.7, 0.05
# How far the camera stands from where the configuration has it, along and about each axis.
_OFFSET_M, _OFFSET_RAD = 0.015, 0.02


@dataclass(frozen=True)
class Trial:
    """One seed.

    Attributes:
        seed: of everything.
        mm: error of the camera's position.
        deg: of its rotation.
        normalised: (6,) error over its stated standard deviation.
        chi2: squared error by the stated covariance, six degrees of freedom.
        held_out_mm: median.
        wall_s: for everything.
        problem: why there is no result; "" if there is.
    """

    seed: int
    mm: float = np.nan
    deg: float = np.nan
    normalised: tuple[float, ...] = (np.nan,) * 6
    chi2: float = np.nan
    held_out_mm: float = np.nan
    wall_s: float = 0.0
    problem: str = ""


class _Silent:
    def moving(self, taken, count):
        pass

    def captured(self, capture, taken, count, estimate):
        pass

    def skipped(self, why):
        pass


def run_trial(seed: int, views: int, resolution: str, arm_mm: float, arm_mrad: float) -> Trial:
    started = time.perf_counter()
    rng = np.random.default_rng([seed, 0xCA1])
    offset = [*rng.normal(scale=_OFFSET_M, size=3), *rng.normal(scale=_OFFSET_RAD, size=3)]
    config = load_config(
        None,
        {
            "camera.resolution": resolution,
            "backend.options.seed": seed,
            "backend.options.objects": 1,
            "backend.options.board": True,
            "backend.options.camera_offset": offset,
        },
    )
    options = TwinOptions.model_validate(config.backend.options)
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder)
        try:
            with open_twin(config)[0] as cell:
                open_session(session, DEFAULT_BOARD, cell.camera.read(), resume=False)
                held = HeldBoard(DEFAULT_BOARD, held_by_gripper(DEFAULT_BOARD))
                collect(cell, session, held, views, seed, _Silent())
        except CellError as error:
            return Trial(seed, wall_s=time.perf_counter() - started, problem=str(error))
        seen = read_session(session)
    scale = np.repeat([1e-3 * arm_mm, 1e-3 * arm_mrad], 3)
    disturbed = replace(seen, T_base_flange=change(seen.T_base_flange, rng.normal(scale=scale, size=(len(seen), 6))))
    solution = solve(disturbed)
    wall_s = time.perf_counter() - started
    spread = solution.spread("mm")
    if not solution.accepted or solution.estimate is None or spread is None:
        return Trial(seed, wall_s=wall_s, problem=solution.verdict.words)
    off = difference(solution.estimate.X, options.camera_pose(config.camera))
    covariance = solution.estimate.covariance
    return Trial(
        seed,
        mm=float(1e3 * np.linalg.norm(off[:3])),
        deg=float(np.degrees(np.linalg.norm(off[3:]))),
        normalised=tuple((off / np.sqrt(np.diag(covariance))).tolist()),
        chi2=float(off @ np.linalg.solve(covariance, off)),
        held_out_mm=spread.median,
        wall_s=wall_s,
    )


def summarise(trials: list[Trial]) -> dict[str, object]:
    done = [t for t in trials if not t.problem]
    within = sum(t.mm <= LIMIT_MM and t.deg <= LIMIT_DEG for t in done)
    normalised = np.abs([t.normalised for t in done]).reshape(-1, 6)
    return {
        "trials": len(trials),
        f"within {LIMIT_MM} mm and {LIMIT_DEG} degrees": within,
        "worst mm": max((t.mm for t in done), default=None),
        "worst degrees": max((t.deg for t in done), default=None),
        "median mm": float(np.median([t.mm for t in done])) if done else None,
        "median degrees": float(np.median([t.deg for t in done])) if done else None,
        # 68.3, 95.4 and 99.7 % of normal numbers.
        **{f"share within {k} sigma": float((normalised <= k).mean()) if done else None for k in (1, 2, 3)},
        # Six for the squared error of six numbers by a right covariance.
        "mean chi2 of 6": float(np.mean([t.chi2 for t in done])) if done else None,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description="Calibrate in the twin for many seeds.")
    parser.add_argument("--seeds", type=int, default=20, help="how many")
    parser.add_argument("--first", type=int, default=0, help="the first one")
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--resolution", default="1280x720", choices=("640x480", "1280x720"))
    parser.add_argument("--arm-mm", type=float, default=0.0)
    parser.add_argument("--arm-mrad", type=float, default=0.0)
    parser.add_argument("--workers", type=int, default=1, help="seeds at once")
    parser.add_argument("--json", type=Path, help="write all figures here")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    job = partial(
        run_trial,
        views=arguments.views,
        resolution=arguments.resolution,
        arm_mm=arguments.arm_mm,
        arm_mrad=arguments.arm_mrad,
    )
    trials = []
    with contextlib.ExitStack() as stack:
        if arguments.workers > 1:
            pool = stack.enter_context(multiprocessing.get_context("spawn").Pool(arguments.workers))
            results = pool.imap(job, seeds)
        else:
            results = map(job, seeds)
        for trial in results:
            trials.append(trial)
            off = " ".join(f"{value:+.1f}" for value in trial.normalised)
            line = trial.problem or (
                f"{trial.mm:.3f} mm  {trial.deg:.4f} deg  held-out {trial.held_out_mm:.3f} mm  sigmas {off}"
            )
            sys.stdout.write(f"seed {trial.seed:3d}  {line}  ({trial.wall_s:.0f} s)\n")
            sys.stdout.flush()
    summary = summarise(trials)
    for key, value in summary.items():
        sys.stdout.write(f"{key:36} {value if not isinstance(value, float) else f'{value:.4g}'}\n")
    if arguments.json:
        rows = [vars(trial) for trial in trials]
        arguments.json.write_text(json.dumps({"summary": summary, "trials": rows}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
