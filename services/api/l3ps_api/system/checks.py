"""Whether what the API stands on answers."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from l3ps_api.problems import ApiProblem, ErrorItem
from l3ps_api.services import Services
from l3ps_platform.catalog.migrate import is_current
from l3ps_platform.errors import CatalogUnavailable, PlatformError

_REMEDIES = {
    "catalog": "Check the database and L3PS_DATABASE_URL; each release: `python -m l3ps_platform.catalog.migrate`.",
    "store": "Check the object store and L3PS_OBJECTS_URL.",
    "queue": "Check Redis and L3PS_REDIS_URL.",
}


def check_all(services: Services) -> dict[str, str]:
    """Ask catalog, store and queue at once; raises a 503 problem naming those that do not answer."""
    checks: dict[str, Callable[[], None]] = {
        "catalog": lambda: _catalog(services),
        "store": services.store.ensure,  # also makes a bucket that was not there when the process started
        "queue": services.queue.ping,
    }
    with ThreadPoolExecutor(len(checks)) as pool:
        answers = dict(zip(checks, pool.map(_answer, checks.values()), strict=True))
    failed = [
        ErrorItem(where=name, what=answer, remedy=_REMEDIES[name]) for name, answer in answers.items() if answer != "ok"
    ]
    if failed:
        names = ", ".join(item.where for item in failed)
        detail = f"Not ready: {names}. {failed[0].what[:1].upper()}{failed[0].what[1:]}."
        raise ApiProblem(503, "not-ready", "Not ready", detail, failed, headers={"Retry-After": "2"})
    return answers


def _catalog(services: Services) -> None:
    services.catalog.ping()
    with services.catalog.reading() as session:
        if not is_current(session.connection()):
            raise CatalogUnavailable("the catalog's schema is not the one this release expects")


def _answer(check: Callable[[], None]) -> str:
    try:
        check()
    except PlatformError as error:
        return str(error)
    return "ok"
