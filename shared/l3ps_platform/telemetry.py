"""Logs: one JSON object a line (or coloured text on a terminal), each with the ids of what is being worked on.

Log with ``structlog.get_logger(__name__).info("stage done", points=n)``; ids bound with :func:`bound` appear in every
line of the thread or request, also in lines of libraries that use the standard ``logging``.
"""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import structlog

from l3ps_platform.settings import Settings

# Chatty below WARNING, and nothing in it that our own lines do not say.
_QUIET = ("urllib3", "kombu", "amqp", "celery.redirected", "alembic", "httpx", "httpcore")

_SECRET = re.compile(r"(l3ps_key_[0-9a-z]{25}_)[A-Za-z0-9_-]{43}")


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
    last.append(_without_secrets)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(structlog.stdlib.ProcessorFormatter(foreign_pre_chain=shared, processors=last))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(settings.log_level)
    for name in _QUIET:
        logging.getLogger(name).setLevel(max(logging.WARNING, root.level))


@contextmanager
def bound(**ids: str | int | None) -> Iterator[None]:
    """Put ids (``job``, ``scene``, ``stage`` …) into every line logged inside; None is left out."""
    with structlog.contextvars.bound_contextvars(**{name: id for name, id in ids.items() if id is not None}):
        yield


def _without_secrets(_: object, __: str, line: Any) -> str:
    """Leave the secret out of an API key, wherever a client has put one; the key's id stays."""
    return _SECRET.sub(r"\1…", str(line))


def _naming(service: str) -> structlog.types.Processor:
    def name(_: object, __: str, event: structlog.types.EventDict) -> structlog.types.EventDict:
        event.setdefault("service", service)
        return event

    return name
