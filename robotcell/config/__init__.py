"""`cell.toml` and the calibration file: what a cell is, read and checked."""

from robotcell.config.backends import Backend, find_backend
from robotcell.config.cell_file import load_config, parse_setting, wrong_values
from robotcell.config.schema import (
    BackendChoice,
    Bin,
    CameraMount,
    CellConfig,
    JournalPlace,
    KeepOut,
    Limits,
    Table,
    Workspace,
)

__all__ = [
    "Backend",
    "BackendChoice",
    "Bin",
    "CameraMount",
    "CellConfig",
    "JournalPlace",
    "KeepOut",
    "Limits",
    "Table",
    "Workspace",
    "find_backend",
    "load_config",
    "parse_setting",
    "wrong_values",
]
