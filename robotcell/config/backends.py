"""The backends by name: which devices stand behind the interfaces."""

from __future__ import annotations

from functools import lru_cache
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Protocol

from robotcell.errors import ConfigError

if TYPE_CHECKING:
    from pydantic import BaseModel

    from robotcell.config.schema import CellConfig
    from robotcell.interfaces import Devices, GripperRange


class Backend(Protocol):
    """An entry point of the group `robotcell.backends`: a class with these three members."""

    Options: type[BaseModel]

    @staticmethod
    def open(config: CellConfig) -> Devices:
        """The devices of a cell, not yet connected; `config.backend.options` fits `Options`."""
        ...

    @staticmethod
    def cell_name(config: CellConfig) -> str | None:
        """What names the cell beyond this process, the same however its file is written; None if it ends with it.

        One process at a time opens a cell of a name, and a stop of it holds for the next one.
        """
        ...

    @staticmethod
    def gripper_range(config: CellConfig) -> GripperRange:
        """What the gripper of a cell can reach, by its options alone; its device reports the same once connected."""
        ...


@lru_cache
def find_backend(name: str) -> Backend:
    """The backend of that name.

    Raises:
        ConfigError: there is none, or it cannot be imported; the message lists those that are installed.
    """
    installed = {entry.name: entry for entry in entry_points(group="robotcell.backends")}
    if name not in installed:
        raise ConfigError(f"no backend is called {name!r}; installed: {', '.join(sorted(installed)) or 'none'}")
    try:
        backend: Backend = installed[name].load()
    except ImportError as error:
        raise ConfigError(
            f"backend {name!r} cannot be imported ({error}); install its extra, for the twin: "
            "pip install 'robotcell[twin]'"
        ) from error
    return backend
