"""Loading the physics engine."""

from __future__ import annotations

import os
import sys
from typing import Any


def load_pybullet() -> Any:
    """The module pybullet, without the line that its first import writes to stderr past Python."""
    if "pybullet" not in sys.modules:
        stderr = os.dup(2)
        with open(os.devnull, "wb") as nowhere:  # noqa: PTH123 - only its descriptor is of interest
            os.dup2(nowhere.fileno(), 2)
        try:
            import pybullet  # noqa: F401
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
    return sys.modules["pybullet"]
