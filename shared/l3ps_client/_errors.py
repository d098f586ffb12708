"""What can go wrong between a program and the service.

L3psClientError
├── Unreachable             nobody answers, or the service cannot work just now; trying again later may help
├── Refused                 the service refused a request (carries status and problem document)
│   ├── InvalidRequest      400, 413, 415, 422: the request cannot be used as it is
│   ├── Unauthorized        401: the token is missing, unknown, expired or revoked
│   ├── Forbidden           403: the token's scope does not permit this
│   ├── NotFound            404, 410: there is no such resource, or none of it any more
│   ├── Conflict            409, 412: sound, but not in the present state of things
│   └── TooManyRequests     429: asked too often (carries ``retry_after``, seconds)
├── Damaged                 bytes that are not those announced; nothing of them was kept
├── TimedOut                what was waited for is not over yet; it goes on at the service
└── webhooks.BadSignature   a delivery that the service did not send, or not just now
"""

from __future__ import annotations

from typing import Any

Document = dict[str, Any]


class L3psClientError(Exception):
    """Root of everything this package raises on purpose."""


class Unreachable(L3psClientError):  # noqa: N818
    """The service does not answer, or says that it cannot work just now.

    Attributes:
        retry_after: seconds until trying again makes sense, where the service says so.
    """

    def __init__(self, message: str, retry_after: float | None = None) -> None:
        super().__init__(message)
        self.retry_after = retry_after


class Refused(L3psClientError):  # noqa: N818
    """The service refused a request.

    Attributes:
        status: HTTP status.
        document: its problem document (RFC 9457), or what could be made of the answer.
    """

    def __init__(self, status: int, document: Document) -> None:
        self.status, self.document = status, document
        super().__init__("\n".join(sentences(document)))

    @property
    def code(self) -> str:
        """The stable name of the kind of problem, such as ``unknown-job``; empty where the answer has none."""
        return str(self.document.get("type") or "").rpartition(":")[2]


class InvalidRequest(Refused):
    """The request cannot be used as it is; ``document["errors"]`` names the fields."""


class Unauthorized(Refused):
    """The token is missing, unknown, expired or revoked."""


class Forbidden(Refused):
    """The token's scope does not permit this."""


class NotFound(Refused):
    """There is no such resource, or the token's project has none."""


class Conflict(Refused):
    """The request is sound but does not fit the present state of things."""


class TooManyRequests(Refused):
    """Asked too often.

    Attributes:
        retry_after: seconds until asking again makes sense, where the service says so.
    """

    def __init__(self, status: int, document: Document, retry_after: float | None = None) -> None:
        super().__init__(status, document)
        self.retry_after = retry_after


class Damaged(L3psClientError):  # noqa: N818
    """Bytes that are not those announced; nothing of them was kept."""


class TimedOut(L3psClientError):  # noqa: N818
    """What was waited for is not over yet; it goes on at the service."""


KINDS: dict[int, type[Refused]] = {
    400: InvalidRequest,
    401: Unauthorized,
    403: Forbidden,
    404: NotFound,
    409: Conflict,
    410: NotFound,
    412: Conflict,
    413: InvalidRequest,
    415: InvalidRequest,
    422: InvalidRequest,
}
"""The exception for a status; ``Refused`` itself for the others."""


def sentences(document: Document) -> list[str]:
    """A problem document as sentences for a person: what is wrong, then each error that this did not say already."""
    detail = str(document.get("detail") or document.get("title") or "The service refused the request.")
    lines = [detail]
    for error in document.get("errors") or []:
        where, what, remedy = (str(error.get(key) or "").rstrip(".") for key in ("where", "what", "remedy"))
        if what and what in detail:
            continue
        line = f"  {where}: {what}." if where else f"  {what}."
        lines.append(f"{line} {remedy}." if remedy else line)
    return lines
