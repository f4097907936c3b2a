"""What one period of the guard costs: it is paid 125 times a second."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from robotcell.config import CellConfig
from robotcell.geometry import rg2, ur5e
from robotcell.interfaces import ArmMode, ArmState
from robotcell.motion.course import Course, Phase
from robotcell.motion.guard import Guard, Latch

if TYPE_CHECKING:
    from pytest_benchmark.fixture import BenchmarkFixture


@pytest.mark.parametrize("samples", [2, 60])
def test_a_period_of_the_guard(benchmark: BenchmarkFixture, samples: int) -> None:
    config = CellConfig()
    q = np.array(config.motion.home_q)
    state = ArmState(
        t=0.0,
        q=q,
        qd=np.full(6, 0.2),
        T_base_tcp=ur5e.forward(q) @ rg2.T_FLANGE_TCP,
        wrench=np.zeros(6),
        mode=ArmMode.READY,
    )
    path = q + np.linspace(-0.5, 0.5, samples)[:, None]
    guard = Guard(config, Latch())
    guard.begin(Course("carry", Phase.CARRY, path, 0.1, 0.003, 0.06), state)
    benchmark(guard.check, state, 0.0)
