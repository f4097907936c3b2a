"""`robotcell twin record`: writes a recording of what the twin's camera sees."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cli.console import progress, report_error, results
from cli.twin import as_twin
from robotcell.errors import CellError
from sim_twin.d415.renderer import FRAMES_PER_S
from sim_twin.wire.d415.recorder import record

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path


def run_record(cell_file: Path | None, options: Mapping[str, Any], out: Path, seconds: float) -> int:
    """Record; returns the exit code.

    Args:
        cell_file: TOML file of the cell; its backend may be any, its arrangement is what counts.
        options: of the twin, above those of the file.
        out: the file to write.
        seconds: of frames.
    """
    frames = max(1, round(seconds * FRAMES_PER_S))
    try:
        with progress().status("building the cell") as status:
            record(as_twin(cell_file, options), out, frames, lambda n: status.update(f"{n} of {frames} frames"))
    except CellError as error:
        return report_error(error)
    results().print(f"{out}: {frames} frames, {out.stat().st_size / 1e6:.0f} MB")
    return 0
