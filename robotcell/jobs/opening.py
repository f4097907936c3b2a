"""Opening a cell whose stops are kept in the journal, for every process that will ever open it."""

from __future__ import annotations

from contextlib import closing
from datetime import timezone
from typing import TYPE_CHECKING

import numpy as np

from robotcell import cell as cells
from robotcell.config import find_backend
from robotcell.jobs.journal import Journal
from robotcell.jobs.journal_tables import StopRow
from robotcell.motion.guard import Stop

if TYPE_CHECKING:
    from robotcell.cell import Cell
    from robotcell.config import CellConfig
    from robotcell.config.schema import JournalPlace


class JournalStops:
    """The stops of a cell, in the journal; a `StopStore`.

    Args:
        place: of the journal.
        cell: name of the cell.
    """

    def __init__(self, place: JournalPlace, cell: str) -> None:
        self._place = place
        self._cell = cell

    def load(self) -> Stop | None:
        """The stop that stands. No journal is made for it."""
        if self._place.url is None and not self._place.default_file.exists():
            return None
        with closing(Journal(self._place.database_url())) as journal:
            row = journal.standing_stop(self._cell)
        if row is None:
            return None
        q = None if row.q is None else np.array(row.q, np.float64)
        # SQLite forgets that times are UTC.
        return Stop(row.what, row.at.replace(tzinfo=timezone.utc), q, row.job_id)

    def save(self, stop: Stop) -> None:
        """Record a stop, of the job that runs."""
        q = None if stop.q is None else [float(angle) for angle in stop.q]
        with closing(Journal(self._place.database_url())) as journal:
            job = journal.newest_job(self._cell)
            running = job.id if job is not None and job.status == "running" else None
            journal.add_stop(StopRow(cell=self._cell, what=stop.what, at=stop.at, q=q, job_id=running))

    def clear(self) -> None:
        """Record that an operator has recovered the cell."""
        if self._place.url is None and not self._place.default_file.exists():
            return
        with closing(Journal(self._place.database_url())) as journal:
            journal.clear_stops(self._cell)


def open_cell(config: CellConfig) -> Cell:
    """The cell of a configuration, its devices not yet connected: use it in a `with` statement.

    One process at a time has the cell open. A stop of it is kept in the journal: it stands until `robotcell recover`,
    or `Cell.recover`, whichever process comes next. In a twin without servers a stop ends with the process, as its
    world does.

    Raises:
        ConfigError: its backend is not installed.
    """
    name = find_backend(config.backend.name).cell_name(config)
    return cells.open_cell(config, None if name is None else JournalStops(config.journal, name))
