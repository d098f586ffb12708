"""What Celery prints past the log, made into lines of the log: its banner, its warnings, its words on stopping."""

from __future__ import annotations

import os
from typing import Any

import celery.apps.worker

from l3ps_platform.settings import get_settings
from l3ps_platform.telemetry import configure_logging, line

_STANDARD_ERROR = 2


def make_lines(instance: Any, **_: Any) -> None:
    """At the worker's start, before it says anything. On a terminal Celery may talk as it likes."""
    settings = get_settings()
    if settings.log_format == "json":
        configure_logging(settings, "worker")
        instance.quiet = True  # no banner
        celery.apps.worker.safe_say = _say


def _say(message: str, _stream: Any = None) -> None:
    """In a signal handler, where a lock of the log may be held by what was interrupted."""
    os.write(_STANDARD_ERROR, line("worker", str(message).strip()))
