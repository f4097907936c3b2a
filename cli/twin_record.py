"""`robotcell twin record`: writes a recording of what the twin's camera sees."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cli.console import progress, report_error, results
from robotcell.errors import CellError
from sim_twin.wire.d415.recorder import frames_in, record
from sim_twin.wire.twin_config import load_as_twin

if TYPE_CHECKING:
    from pathlib import Path

    from cli.options import CellChoice


def run_record(choice: CellChoice, out: Path, seconds: float) -> int:
    """Record; returns the exit code.

    Args:
        choice: the cell; its backend may be any, its arrangement is what counts.
        out: the file to write.
        seconds: of frames.
    """
    frames = frames_in(seconds)
    try:
        with progress().status("building the cell") as status:
            config = load_as_twin(choice.file, *choice.overrides())
            record(config, out, frames, lambda count: status.update(f"{count} of {frames} frames"))
    except CellError as error:
        return report_error(error)
    results().print(f"{out}: {frames} frames, {out.stat().st_size / 1e6:.0f} MB")
    return 0
