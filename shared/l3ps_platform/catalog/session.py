"""Transactions: SQLite in WAL or PostgreSQL, with messages that leave only after the commit."""

from __future__ import annotations

import fcntl
import sqlite3
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from copy import copy
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import structlog
from sqlalchemy import Connection, Engine, create_engine, event, make_url, text
from sqlalchemy.exc import InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as NoneFree
from sqlalchemy.orm import ORMExecuteState, Session, with_loader_criteria

from l3ps_platform.catalog.base import Json, Owned
from l3ps_platform.catalog.clean import clean_json, clean_parameters
from l3ps_platform.catalog.kinds import EventKind
from l3ps_platform.catalog.outbox import Happening, write
from l3ps_platform.catalog.states import QueueName, StageName
from l3ps_platform.errors import CatalogUnavailable

log = structlog.get_logger(__name__)

# What is too large for PostgreSQL (class 54) stays so for ever, though the driver calls it operational like an outage.
_TOO_MUCH = "54"

# SQLite allows one writer at a time; ours hold the lock for milliseconds, so half a minute is never a real wait.
SQLITE_BUSY_MS = 30_000


@dataclass(frozen=True, slots=True)
class StageMessage:
    """All that travels through the queue, and where to."""

    stage_id: str
    attempt: int
    name: StageName
    queue: QueueName


Sender = Callable[[Sequence[StageMessage]], None]


@dataclass(slots=True)
class Transaction:
    """A writing transaction: its session, its clock, and the messages to send once it is committed.

    The session of a scoped catalog sees the rows of its project alone.

    Attributes:
        session: the SQLAlchemy session.
        now: one time for everything the transaction writes, by the database server's clock, so that workers
            whose clocks disagree still agree on leases.
        outbox: messages to send after the commit.
        happenings: events that go into the log with the commit.
    """

    session: Session
    now: datetime
    outbox: list[StageMessage] = field(default_factory=list)
    happenings: list[Happening] = field(default_factory=list)

    def emit(self, kind: EventKind, subject: Owned, data: Json) -> None:
        """Something happened to a row: it goes into the log, and to webhooks, if and when the transaction commits."""
        self.happenings.append(Happening(kind, subject, data))


class Catalog:
    """The database. Cheap to make; connects on first use; make one per process (after a fork).

    As made it shows all rows, as workers and the reconciler need it; :meth:`scoped` is for those who act for a client.

    Args:
        url: SQLAlchemy URL, ``sqlite:///PATH`` or ``postgresql+psycopg://…``.
        sender: called with the messages of a transaction after its commit; None drops them, which is right for
            processes that enqueue nothing and for tests (the reconciler finds lost messages).
    """

    def __init__(self, url: str, sender: Sender | None = None) -> None:
        self.url = url
        self._sender = sender
        self._project: str | None = None
        self._heard: Callable[[float], None] | None = None
        self.engine = make_engine(url)

    def scoped(self, project_id: str) -> Catalog:
        """This catalog as one project sees it: rows of others do not exist, new rows are the project's."""
        scoped = copy(self)
        scoped._project = project_id
        return scoped

    def whole(self) -> Catalog:
        """This catalog with every project's rows, for whoever cleans up."""
        whole = copy(self)
        whole._project = None
        return whole

    def heard(self, listener: Callable[[float], None]) -> Catalog:
        """This catalog, which tells someone how many seconds each of its transactions took, whatever its end."""
        heard = copy(self)
        heard._heard = listener
        return heard

    @contextmanager
    def alone(self, what: str) -> Iterator[bool]:
        """Whether nobody else is at this work now, in any process; held until the block ends or the process dies."""
        if self.engine.dialect.name == "sqlite":
            with open(f"{self.engine.url.database}.{what}", "w") as file:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    yield False
                else:
                    yield True
            return
        # A lock of the session, not of a transaction: no snapshot is held open while the work goes on.
        with self._connected() as connection:
            key = {"key": zlib.crc32(what.encode())}
            mine = bool(connection.execute(text("SELECT pg_try_advisory_lock(:key)"), key).scalar_one())
            try:
                yield mine
            finally:
                if mine:
                    connection.execute(text("SELECT pg_advisory_unlock(:key)"), key)

    @contextmanager
    def _connected(self) -> Iterator[Connection]:
        with _unavailable(), self.engine.connect() as connection:
            yield connection.execution_options(isolation_level="AUTOCOMMIT")

    @contextmanager
    def transaction(self) -> Iterator[Transaction]:
        """A writing transaction; commits on leaving, rolls back on any exception, then sends the messages.

        A message that cannot be sent is logged and left to the reconciler: the row says ``queued`` and is the truth.
        """
        with self._session(write=True) as session:
            transaction = Transaction(session, self.now(session))
            yield transaction
            if transaction.happenings:
                write(session, transaction.happenings, transaction.now)
            session.commit()
        self._flush(transaction.outbox)

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """A session for queries; whatever it changes is rolled back."""
        with self._session(write=False) as session:
            yield session

    def ping(self) -> None:
        """Raise CatalogUnavailable unless the database answers."""
        with self.reading() as session:
            session.execute(text("SELECT 1"))

    def dispose(self) -> None:
        """Close all connections."""
        self.engine.dispose()

    @contextmanager
    def _session(self, *, write: bool) -> Iterator[Session]:
        begun = time.monotonic()
        # Around the session, because one whose server has gone fails at its close as well, and may be long about it.
        made = _CatalogSession(self.engine, expire_on_commit=False, info={"project": self._project})
        with _unavailable(), ExitStack() as closed, made as session:
            session.connection(execution_options={"l3ps_write": write})
            if self._heard is not None:  # not before: a wait for a free connection says nothing about the database
                closed.callback(lambda listener: listener(time.monotonic() - begun), self._heard)
            yield session

    def now(self, session: Session) -> datetime:
        """The database server's time."""
        if self.engine.dialect.name == "sqlite":
            return datetime.now(UTC)  # the database is on this machine
        moment: datetime = session.execute(text("SELECT clock_timestamp()")).scalar_one()
        return moment.astimezone(UTC)

    def _flush(self, messages: Sequence[StageMessage]) -> None:
        if not messages or self._sender is None:
            return
        try:
            self._sender(messages)
        except Exception:
            log.warning("messages not sent, the reconciler will", stages=[m.stage_id for m in messages], exc_info=True)


@contextmanager
def _unavailable() -> Iterator[None]:
    """Tell of a database that does not answer as CatalogUnavailable."""
    try:
        yield
    except (OperationalError, InterfaceError) as error:
        if str(getattr(error.orig, "sqlstate", "")).startswith(_TOO_MUCH):
            raise
        raise CatalogUnavailable(f"the catalog does not answer: {error.orig}") from error
    except NoneFree as error:  # all are in use, most likely by those who wait for a database that does not answer
        raise CatalogUnavailable("the catalog does not answer: no connection became free") from error


class _CatalogSession(Session):
    """A session that keeps to its project, if it has one."""


def project_of(session: Session, project_id: str | None = None) -> str:
    """The given project, else the one the session keeps to. ValueError where there is neither."""
    found = project_id or session.info.get("project")
    if found is None:
        raise ValueError("this row needs a project: name one, or use a scoped catalog")
    return str(found)


@event.listens_for(_CatalogSession, "do_orm_execute")
def _show_own_rows(state: ORMExecuteState) -> None:
    project = state.session.info["project"]
    if project is not None and not state.is_column_load and not state.is_relationship_load:
        own = with_loader_criteria(Owned, lambda row: row.project_id == project, include_aliases=True)
        state.statement = state.statement.options(own)


@event.listens_for(_CatalogSession, "before_flush")
def _own_new_rows(session: Session, _context: object, _instances: object) -> None:
    for row in session.new:
        if isinstance(row, Owned):
            row.project_id = project_of(session, row.project_id)


# Connections are opened when they are needed and kept. Beyond a smaller pool they would be closed after each use: five
# bursts of 200 requests opened 55 connections with 5 kept and 10 more allowed, and 15 so.
_ENGINE: dict[str, Any] = {"pool_size": 15, "max_overflow": 0, "json_serializer": clean_json}


# A server that falls silent, because its machine or the way to it is gone, is given up after 25 s; Linux alone would
# wait for two hours, and with it every lease, retry and request. Unanswered data counts as well as an idle connection.
_POSTGRESQL: dict[str, Any] = {
    "connect_timeout": 5,
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 25_000,
}


def make_engine(url: str) -> Engine:
    """An engine with the settings each database needs."""
    engine = _engine_of(url)
    event.listen(engine, "before_cursor_execute", _clean_parameters, retval=True)
    return engine


def _engine_of(url: str) -> Engine:
    parsed = make_url(url)
    if parsed.get_backend_name() == "sqlite":
        if parsed.database:
            Path(parsed.database).parent.mkdir(parents=True, exist_ok=True)
        engine = create_engine(url, **_ENGINE, connect_args={"timeout": SQLITE_BUSY_MS / 1000})
        event.listen(engine, "connect", _on_sqlite_connect)
        event.listen(engine, "begin", _on_sqlite_begin)
        return engine
    # A pooled connection that died with the server is replaced before use instead of failing the first request.
    return create_engine(url, pool_pre_ping=True, **_ENGINE, connect_args=_POSTGRESQL)


def _clean_parameters(
    _connection: Connection, _cursor: object, statement: str, parameters: Any, _context: object, _many: bool
) -> tuple[str, Any]:
    return statement, clean_parameters(parameters)


def _on_sqlite_connect(connection: sqlite3.Connection, _record: Any) -> None:
    # The driver's own BEGIN is deferred: two readers that both go on to write then fail at once, whatever the
    # busy timeout. We say BEGIN IMMEDIATE ourselves.
    connection.isolation_level = None
    cursor = connection.cursor()
    cursor.execute(f"PRAGMA busy_timeout={SQLITE_BUSY_MS}")
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA synchronous=NORMAL")  # safe in WAL against a crash of the process; fewer syncs
    cursor.execute("PRAGMA foreign_keys=ON")
    cursor.close()


def _on_sqlite_begin(connection: Connection) -> None:
    write = connection.get_execution_options().get("l3ps_write", True)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")
