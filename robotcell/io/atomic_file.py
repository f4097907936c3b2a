"""Files that are there as a whole or not at all, whatever happens while they are written."""

from __future__ import annotations

import os
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from robotcell.errors import CellError, StorageError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """The file to write instead: once it is written, and on the disk, it takes the place of `path`.

    A reader, also after a crash, sees what stood there before or all of the new. An error inside leaves what stood
    there.

    Raises:
        StorageError: it cannot be written.
    """
    part = path.with_name(f"{path.name}.part")
    try:
        yield part
        descriptor = os.open(part, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        part.replace(path)
    except BaseException as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        if isinstance(error, OSError) and not isinstance(error, CellError):
            raise StorageError(
                f"{path} cannot be written: {error.strerror or error}; check the folder and the disk"
            ) from error
        raise


def write_whole(path: Path, text: str) -> None:
    """Write a text file by `replaced`.

    Raises:
        StorageError: it cannot be written.
    """
    with replaced(path) as part:
        part.write_text(text, encoding="utf-8")
