"""Whether a calibration's stated covariance is true: `python -m tests.benchmarks.calibration_coverage [SEEDS]`.

Made-up views with known answers (tests/calibration/synthetic.py), one solve per seed. If the covariance is true, the
error's squared Mahalanobis distance is below the 68 % (95 %) point of chi squared with six degrees of freedom in 68 %
(95 %) of the seeds, and an axis' error is within one (1.96) standard deviations as often.
"""

import sys

import numpy as np
from scipy.stats import chi2

from calibration.solve.pipeline import solve
from calibration.solve.se3 import difference
from tests.calibration.synthetic import as_poses, make_views

# mount, views, corner noise [px], position [m] and rotation [rad] noise of the arm, poses instead of corners
CASES = (
    ("fixed", 20, 0.15, 0.0, 0.0, False),
    ("fixed", 20, 0.20, 0.0002, 0.0003, False),
    ("flange", 20, 0.20, 0.0002, 0.0003, False),
    ("fixed", 20, 0.50, 0.0005, 0.0005, False),
    ("fixed", 12, 0.20, 0.0002, 0.0003, False),
    ("fixed", 50, 0.20, 0.0002, 0.0003, False),
    ("fixed", 20, 0.0, 0.0002, 0.0003, True),
    ("flange", 20, 0.0, 0.0002, 0.0003, True),
)
SEEDS = 200


def errors(case, seed):
    """Error of X in small changes (6,), its covariance (6, 6), and the names of rejected views."""
    mount, count, corner_px, position_m, rotation_rad, poses = case
    views, truth = make_views(
        seed, count, mount=mount, corner_px=corner_px, position_m=position_m, rotation_rad=rotation_rad
    )
    if poses:
        # The board where the arm states that it is, seen with noise: the arm's own errors play no part.
        views = as_poses(views, truth, seed=seed, position_m=0.0003, rotation_rad=0.0005)
    solution = solve(views)
    estimate = solution.estimate
    return difference(estimate.X, truth.X), estimate.covariance, solution.rejected


def main() -> None:
    """Print one row per case."""
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else SEEDS
    sys.stdout.write(
        "| mount | views | corners px | arm mm, mrad | median error mm, deg | 6D at 68 / 95 % | axis at 68 / 95 % |"
        " left out |\n|---|---|---|---|---|---|---|---|\n"
    )
    for case in CASES:
        rows = [errors(case, seed) for seed in range(seeds)]
        e = np.array([row[0] for row in rows])
        covariances = np.array([row[1] for row in rows])
        d2 = np.einsum("si,si->s", e, np.linalg.solve(covariances, e[..., None])[..., 0])
        z = np.abs(e) / np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
        mount, count, corner_px, position_m, rotation_rad, poses = case
        seen = "poses" if poses else f"{corner_px:.2f}"
        arm = "-" if poses else f"{1e3 * position_m:.1f}, {1e3 * rotation_rad:.1f}"
        mm = 1e3 * np.median(np.linalg.norm(e[:, :3], axis=1))
        deg = np.rad2deg(np.median(np.linalg.norm(e[:, 3:], axis=1)))
        whole = [100 * np.mean(d2 < chi2.ppf(level, 6)) for level in (0.68, 0.95)]
        axis = [100 * np.mean(z < sigmas) for sigmas in (1.0, 1.96)]
        left_out = sum(len(row[2]) for row in rows) / (seeds * count)
        sys.stdout.write(
            f"| {mount} | {count} | {seen} | {arm} | {mm:.2f}, {deg:.3f} | {whole[0]:.0f} / {whole[1]:.0f} | "
            f"{axis[0]:.0f} / {axis[1]:.0f} | {100 * left_out:.2f} % |\n"
        )
        sys.stdout.flush()


if __name__ == "__main__":
    main()
