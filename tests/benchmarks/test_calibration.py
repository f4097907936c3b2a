"""What solving costs, held-out errors included: `pytest tests/benchmarks/test_calibration.py --benchmark-enable`.

Targets on two cores: 20 views of a ChArUco board 2 s, 200 views 20 s.
"""

import pytest

from calibration.solve.pipeline import solve
from tests.calibration.synthetic import make_views


@pytest.fixture(scope="module")
def views(request):
    count = request.param
    # Without --benchmark-enable the call runs once; few views are enough to see that it does.
    if not request.config.getoption("benchmark_enable"):
        count = 15
    return make_views(0, count, corner_px=0.2, position_m=0.0002, rotation_rad=0.0003)[0]


@pytest.mark.parametrize("views", [20, 200], indirect=True)
@pytest.mark.parametrize("refine_intrinsics", [False, True], ids=["fixed", "refined"])
def test_solve_corners(benchmark, views, refine_intrinsics):
    solution = benchmark.pedantic(
        solve, args=(views,), kwargs={"refine_intrinsics": refine_intrinsics}, rounds=3, warmup_rounds=1
    )
    assert solution.accepted
