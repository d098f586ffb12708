"""Whether what the API stands on answers."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import structlog

from l3ps_api.problems import ApiProblem, ErrorItem
from l3ps_api.services import Services
from l3ps_platform.catalog.migrate import is_current
from l3ps_platform.errors import PlatformError

log = structlog.get_logger(__name__)

_REMEDIES = {
    "catalog": "Check the database and L3PS_DATABASE_URL; each release: `python -m l3ps_platform.catalog.migrate`.",
    "store": "Check the object store and L3PS_OBJECTS_URL.",
    "queue": "Check Redis and L3PS_REDIS_URL.",
}


class _OtherSchema(PlatformError):  # noqa: N818
    """The catalog answers, and is not what this release works with."""


def check_all(services: Services) -> dict[str, str]:
    """Ask catalog, store and queue at once; raises a 503 problem naming those that do not answer.

    Anybody may ask, so names and addresses of servers, which errors are full of, go to the log alone.
    """
    checks: dict[str, Callable[[], None]] = {
        "catalog": lambda: _catalog(services),
        "store": services.store.ensure,  # also makes a bucket that was not there when the process started
        "queue": services.queue.ping,
    }
    with ThreadPoolExecutor(len(checks)) as pool:
        answers = dict(zip(checks, pool.map(_answer, checks, checks.values()), strict=True))
    failed = [
        ErrorItem(where=name, what=answer, remedy=_REMEDIES[name]) for name, answer in answers.items() if answer != "ok"
    ]
    if failed:
        names = ", ".join(item.where for item in failed)
        detail = f"Not ready: {names}. {failed[0].what[:1].upper()}{failed[0].what[1:]}. {failed[0].remedy}"
        raise ApiProblem(503, "not-ready", "Not ready", detail, failed, headers={"Retry-After": "2"})
    return answers


def _catalog(services: Services) -> None:
    services.catalog.ping()
    with services.catalog.reading() as session:
        if not is_current(session.connection()):
            raise _OtherSchema("its schema is not the one this release expects")


def _answer(name: str, check: Callable[[], None]) -> str:
    try:
        check()
    except _OtherSchema as error:
        return str(error)
    except PlatformError as error:
        log.warning("not ready", missing=name, reason=str(error))
        return "it does not answer"
    return "ok"
