"""Made-up views as a session folder."""

from __future__ import annotations

from datetime import datetime, timezone
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.collect.session import SessionHeader, ViewRecord, add_view, create_session
from tests.calibration.synthetic import BOARD, CAMERA, DATE, to_json

if TYPE_CHECKING:
    from pathlib import Path

    from calibration.solve.views import Views

HEADER = SessionHeader(mount="fixed", camera=CAMERA, board=BOARD, started=DATE, software="robotcell test")


def record(views: Views, i: int, **changes: Any) -> ViewRecord:
    """View i as its file has it."""
    assert views.corners is not None
    values = {
        "name": views.names[i],
        "taken": datetime(2026, 3, 1, 12, i, tzinfo=timezone.utc),
        "q": [0.1] * 6,
        "T_base_flange": to_json(views.T_base_flange[i]),
        "T_base_tcp": to_json(views.T_base_flange[i]),
        "ids": to_json(views.corners[i].ids),
        "corners_px": to_json(views.corners[i].px),
    }
    return ViewRecord.model_validate(values | changes)


def write_session(folder: Path, views: Views) -> None:
    """A session of the views, with grey images."""
    create_session(folder, HEADER)
    for i in range(len(views)):
        add_view(folder, record(views, i), np.full((CAMERA.height, CAMERA.width, 3), 90, np.uint8), None)
