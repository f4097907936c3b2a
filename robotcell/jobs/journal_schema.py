"""The version of a journal's tables: a new database gets the newest ones, an old one is migrated.

Alembic does the migrating. Its table `alembic_version` is read without it, since it takes longer to import than a
journal takes to open.
"""

from __future__ import annotations

import fcntl
import os
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import inspect, text

from robotcell.errors import ConfigError
from robotcell.jobs.journal_tables import SCHEMA_REVISION, Base

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sqlalchemy import Connection, Engine

# The revision of journals that were written before revisions were noted.
_FIRST_REVISION = "0001"


def bring_up_to_date(engine: Engine) -> None:
    """Give a database the tables of this program; the first connection to it is made here.

    Any number of processes may do this to a SQLite file at once. Another database is made by one of them first.

    Raises:
        ConfigError: the database belongs to a newer version, or to another program.
        OSError: its folder cannot be opened.
        SQLAlchemyError: it cannot be read or written.
    """
    with _one_at_a_time(_file_of(engine)):
        tables = set(inspect(engine).get_table_names())
        revision = _revision(engine) if "alembic_version" in tables else None
        if revision is None and tables - {"alembic_version"}:
            if not {"jobs", "actions"} <= tables:
                raise ConfigError("its tables are those of another program; choose another database")
            revision = _FIRST_REVISION
            with engine.begin() as connection:
                _note_revision(connection, revision)
        if revision is None:
            _create(engine)
        elif revision > SCHEMA_REVISION:
            raise ConfigError(
                f"it is of schema {revision} and this program knows {SCHEMA_REVISION}; update robotcell, or choose "
                "another database"
            )
        elif revision != SCHEMA_REVISION:
            _migrate(engine, revision)


@contextmanager
def _one_at_a_time(file: Path | None) -> Iterator[None]:
    """Wait until no other process makes or migrates a SQLite file of this folder.

    SQLite cannot hold the others off by itself: of two connections that give a new file its write-ahead log at once,
    one fails at once, whatever its time-out. The lock is on the folder, since closing the file itself would end the
    locks that SQLite has on it.
    """
    if file is None:
        yield
        return
    folder = os.open(file.parent, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


def _create(engine: Engine) -> None:
    """Make all tables, or none."""
    with engine.begin() as connection:
        if engine.dialect.name == "sqlite":
            # Python's driver begins no transaction for CREATE.
            connection.exec_driver_sql("BEGIN IMMEDIATE")
        Base.metadata.create_all(connection)
        _note_revision(connection, SCHEMA_REVISION)


def _revision(engine: Engine) -> str | None:
    with engine.connect() as connection:
        found = connection.execute(text("SELECT version_num FROM alembic_version")).scalar()
    return None if found is None else str(found)


def _note_revision(connection: Connection, revision: str) -> None:
    connection.execute(
        text(
            "CREATE TABLE IF NOT EXISTS alembic_version "
            "(version_num VARCHAR(32) NOT NULL, CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num))"
        )
    )
    connection.execute(text("DELETE FROM alembic_version"))
    connection.execute(text("INSERT INTO alembic_version (version_num) VALUES (:revision)"), {"revision": revision})


def _migrate(engine: Engine, revision: str) -> None:
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent / "migrations"))
    with engine.connect() as connection:
        if engine.dialect.name == "sqlite":
            _keep_copy(connection, revision)
            # A table is changed by writing it anew, and its rows are pointed to meanwhile.
            connection.exec_driver_sql("PRAGMA foreign_keys=OFF")
            connection.commit()
        config.attributes["connection"] = connection
        command.upgrade(config, SCHEMA_REVISION)
        # Connections are used again, and this one must not go without its foreign keys.
        connection.detach()


def _keep_copy(connection: Connection, revision: str) -> None:
    """Leave the old journal beside the new one, as `journal-0001.db`: a migration that is cut off loses nothing."""
    path = _file_of(connection.engine)
    if path is None:
        return
    copy = path.with_name(f"{path.stem}-{revision}{path.suffix}")
    if not copy.exists():
        connection.exec_driver_sql("VACUUM INTO ?", (str(copy),))


def _file_of(engine: Engine) -> Path | None:
    """The file of a SQLite database; None for another one, and for one in memory."""
    database = engine.url.database
    if engine.dialect.name != "sqlite" or database in {None, "", ":memory:"}:
        return None
    return Path(str(database))
