"""The state of a stage between two rounds, in one file that is always whole."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from robotcell.errors import ConfigError
from robotcell.io.atomic_file import replaced

if TYPE_CHECKING:
    from pathlib import Path

_VERSION = 1


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Replace the checkpoint; a process that is killed leaves the old one or the new one.

    Args:
        path: of the checkpoint.
        state: tensors, numbers, strings, and dictionaries and lists of them.
    """
    with replaced(path) as part:
        torch.save({"version": _VERSION, **state}, part)


def load_checkpoint(path: Path) -> dict[str, Any]:
    """What `save_checkpoint` wrote, on the CPU. Runs no code that a file may contain.

    Raises:
        ConfigError: the file is damaged, or another program's.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # damaged bytes lead the unpickler anywhere
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ConfigError(
            f"{path}: not a whole checkpoint ({reason}); put a copy back, or delete it and "
            "resume: the shards are learned from again, and no scene is played twice"
        ) from error
    if not isinstance(state, dict) or state.get("version") != _VERSION:
        raise ConfigError(f"{path}: a checkpoint of another version of this program; train into another --run folder")
    return state
