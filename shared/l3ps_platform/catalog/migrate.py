"""Bring a catalog to the current schema: at the API's start when embedded, by a step of its own elsewhere.

Run as ``python -m l3ps_platform.catalog.migrate`` with the service's settings.
"""

from __future__ import annotations

import fcntl
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import structlog
from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, Engine, event, text

from l3ps_platform.catalog.session import make_engine
from l3ps_platform.settings import get_settings
from l3ps_platform.telemetry import configure_logging

log = structlog.get_logger(__name__)

_LOCK = 7_335_401  # any constant: API replicas that start together migrate one after the other


def upgrade(url: str, revision: str = "head") -> None:
    """Create or migrate the catalog at ``url`` to a revision; nothing when it is current. Safe to run concurrently."""
    engine = make_engine(url)
    if engine.dialect.name == "sqlite":
        event.listen(engine, "connect", _without_foreign_keys)
    try:
        with _alone(engine), _copied(engine), engine.begin() as connection:
            if connection.dialect.name == "postgresql":
                connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _LOCK})
            if not is_current(connection):
                command.upgrade(_config(connection), revision)
    finally:
        engine.dispose()


@contextmanager
def _alone(engine: Engine) -> Iterator[None]:
    """One process or thread at a time on a SQLite file: switching it to WAL does not wait for others."""
    path = engine.url.database
    if engine.dialect.name != "sqlite" or not path:
        yield
        return
    with open(f"{path}.migrating", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@contextmanager
def _copied(engine: Engine) -> Iterator[None]:
    """A copy of a SQLite catalog of an older release beside it, ``catalog.db.before-REVISION``: the way back.

    PostgreSQL changes its schema in one transaction, and whoever runs it has a back-up.
    """
    path = engine.url.database
    if engine.dialect.name == "sqlite" and path and Path(path).exists():
        with engine.connect() as connection:
            current = MigrationContext.configure(connection).get_current_revision()
            known = current is None or is_current(connection)
        copy = Path(f"{path}.before-{_head()}")
        if not known and not copy.exists():
            with closing(sqlite3.connect(path)) as source, closing(sqlite3.connect(f"{copy}.part")) as target:
                source.backup(target)
            Path(f"{copy}.part").replace(copy)
    yield


def _without_foreign_keys(connection: sqlite3.Connection, _record: Any) -> None:
    # A table that is made anew is dropped first, and the rows that refer to it would go with it.
    connection.execute("PRAGMA foreign_keys=OFF")


def is_current(connection: Connection) -> bool:
    """Whether the schema is the one this code expects."""
    return MigrationContext.configure(connection).get_current_revision() == _head()


def _head() -> str | None:
    return ScriptDirectory.from_config(_config()).get_current_head()


def _config(connection: Connection | None = None) -> Config:
    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent / "migrations"))
    config.attributes["connection"] = connection
    return config


if __name__ == "__main__":
    settings = get_settings()
    configure_logging(settings, "migrate")
    upgrade(settings.catalog_url)
    log.info("the catalog is current")
