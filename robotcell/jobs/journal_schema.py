"""The version of a journal's tables: a new database gets the newest ones, an old one is migrated.

Alembic does the migrating. Its table `alembic_version` is read without it, since it takes longer to import than a
journal takes to open.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import inspect, text
from sqlalchemy.exc import OperationalError

from robotcell.errors import ConfigError
from robotcell.jobs.journal_tables import SCHEMA_REVISION, Base

if TYPE_CHECKING:
    from sqlalchemy import Engine

# The revision of journals that were written before revisions were noted.
_FIRST_REVISION = "0001"
# Processes that open a new database together may each find that another has just made a table.
_CREATE_TRIES = 5


def bring_up_to_date(engine: Engine) -> None:
    """Give a database the tables of this program.

    Raises:
        ConfigError: the database belongs to a newer version, or to another program.
        SQLAlchemyError: it cannot be read or written.
    """
    for attempt in range(_CREATE_TRIES):
        try:
            _bring_up_to_date(engine)
            return
        except OperationalError:
            if attempt == _CREATE_TRIES - 1:
                raise


def _bring_up_to_date(engine: Engine) -> None:
    tables = set(inspect(engine).get_table_names())
    if not tables:
        Base.metadata.create_all(engine)
        _note_revision(engine, SCHEMA_REVISION)
        return
    if not {"jobs", "actions"} <= tables:
        raise ConfigError(
            "journal.url: the database holds tables of another program and no journal; choose another database"
        )
    revision = _revision(engine) if "alembic_version" in tables else None
    if revision is None:
        _note_revision(engine, _FIRST_REVISION)
        revision = _FIRST_REVISION
    if revision > SCHEMA_REVISION:
        raise ConfigError(
            f"journal.url: the journal is of schema {revision} and this program knows {SCHEMA_REVISION}; update "
            "robotcell, or choose another database"
        )
    if revision != SCHEMA_REVISION:
        _migrate(engine)


def _revision(engine: Engine) -> str | None:
    with engine.connect() as connection:
        found = connection.execute(text("SELECT version_num FROM alembic_version")).scalar()
    return None if found is None else str(found)


def _note_revision(engine: Engine, revision: str) -> None:
    with engine.begin() as connection:
        connection.execute(
            text(
                "CREATE TABLE IF NOT EXISTS alembic_version "
                "(version_num VARCHAR(32) NOT NULL, CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num))"
            )
        )
        connection.execute(text("DELETE FROM alembic_version"))
        connection.execute(text("INSERT INTO alembic_version (version_num) VALUES (:revision)"), {"revision": revision})


def _migrate(engine: Engine) -> None:
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent / "migrations"))
    with engine.connect() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, SCHEMA_REVISION)
