"""Logs: one JSON object a line (or coloured text on a terminal), each with the ids of what is being worked on.

Log with ``structlog.get_logger(__name__).info("stage done", points=n)``; ids bound with :func:`bound` appear in every
line of the thread or request, also in lines of libraries that use the standard ``logging``. Warnings and what nobody
catches are logged too, and secrets are left out of every line (:mod:`l3ps_platform.redaction`).
"""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from types import TracebackType

import structlog

from l3ps_platform.redaction import Redactor
from l3ps_platform.settings import Settings

# Chatty below WARNING, and nothing in it that our own lines do not say.
_QUIET = (
    *("urllib3", "kombu", "amqp", "celery.redirected", "alembic", "httpx", "httpcore"),
    *("celery.worker.strategy", "celery.app.trace"),
)


def configure_logging(settings: Settings, service: str) -> None:
    """Send all logs of this process to standard error in one form.

    Args:
        settings: level and format.
        service: name of the process in every line: ``api``, ``worker`` …
    """
    shared: list[structlog.types.Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_logger_name,
        structlog.stdlib.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
        structlog.processors.StackInfoRenderer(),
        _naming(service),
    ]
    structlog.configure(
        processors=[*shared, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
        cache_logger_on_first_use=False,  # children are forked after configuration and configure again
    )
    last: list[structlog.types.Processor] = [structlog.stdlib.ProcessorFormatter.remove_processors_meta]
    if settings.log_format == "json":
        last += [structlog.processors.format_exc_info, structlog.processors.JSONRenderer(ensure_ascii=False)]
    else:
        last += [
            structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), exception_formatter=structlog.dev.plain_traceback)
        ]
    last.append(_redacting(Redactor(settings)))
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(structlog.stdlib.ProcessorFormatter(foreign_pre_chain=shared, processors=last))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(settings.log_level)
    for name in _QUIET:
        logging.getLogger(name).setLevel(max(logging.WARNING, root.level))
    logging.captureWarnings(True)
    sys.excepthook = _uncaught
    threading.excepthook = _uncaught_in_thread


@contextmanager
def bound(**ids: str | int | None) -> Iterator[None]:
    """Put ids (``job``, ``scene``, ``stage`` …) into every line logged inside; None is left out."""
    with structlog.contextvars.bound_contextvars(**{name: id for name, id in ids.items() if id is not None}):
        yield


def line(service: str, event: str) -> bytes:
    """A line in the form of the others, for where logging is not to be had: in a signal handler."""
    now = datetime.now(UTC).isoformat().replace("+00:00", "Z")
    said = {"event": event, "level": "info", "timestamp": now, "service": service, "pid": os.getpid()}
    return (json.dumps(said, ensure_ascii=False) + "\n").encode()


def _naming(service: str) -> structlog.types.Processor:
    def name(_: object, __: str, event: structlog.types.EventDict) -> structlog.types.EventDict:
        event.setdefault("service", service)
        event.setdefault("pid", os.getpid())
        return event

    return name


def _redacting(redact: Redactor) -> structlog.types.Processor:
    def leave_out(_: object, __: str, rendered: object) -> str:
        return redact(str(rendered))

    return leave_out


def _uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt):
        return
    logging.getLogger("uncaught").critical("the process ends with an exception", exc_info=(kind, error, trace))


def _uncaught_in_thread(failed: threading.ExceptHookArgs) -> None:
    if failed.exc_value is not None and not isinstance(failed.exc_value, SystemExit):
        info = (failed.exc_type, failed.exc_value, failed.exc_traceback)
        name = failed.thread.name if failed.thread is not None else "?"
        logging.getLogger("uncaught").error("a thread ends with an exception: %s", name, exc_info=info)
