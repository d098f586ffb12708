"""Requests to the service and to its object store: what is repeated, how long, and what an error answer becomes."""

from __future__ import annotations

import random
import ssl
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from functools import cache
from typing import Any
from urllib.request import getproxies
from uuid import uuid4

import httpx

from l3ps_client._bulk import BulkTransport
from l3ps_client._config import Config
from l3ps_client._errors import KINDS, Document, Refused, TooManyRequests, Unreachable, sentences

_LATER = (429, 503)  # the service did nothing and says when to come back
_NOT_THE_SERVICE = (502, 504)  # a proxy that found nobody behind it, or lost patience

Sleep = Callable[[float], object]


@dataclass(frozen=True)
class Retry:
    """How patient a client is.

    Attributes:
        tries: how often a request is sent before its failure is reported; parts of files get two more.
        first: seconds before the second try; doubled for each further one, with a quarter of jitter.
        longest: bound of these pauses, seconds.
        longest_wait: bound of what ``Retry-After`` may ask for, seconds; a longer one is reported at once.
        in_progress: seconds that the answer to a POST is asked for while the service says that it is still at it. That
            uses up no try: the service goes on, and takes a request whose process died for dead after a minute.
    """

    tries: int = 4
    first: float = 0.2
    longest: float = 10.0
    longest_wait: float = 30.0
    in_progress: float = 600.0

    def pause(self, attempt: int) -> float:
        """Seconds between this try, counted from 1, and the next."""
        return float(min(self.first * 2 ** (attempt - 1), self.longest) * random.uniform(0.75, 1.25))


class Wire:
    """The connections of one client.

    Args:
        config: where the service is and who asks.
        timeout: seconds without a byte before an answer is given up.
        retry: how patient to be.
    """

    def __init__(self, config: Config, timeout: float, retry: Retry) -> None:
        self.config, self.timeout, self.retry = config, timeout, retry
        headers = {}
        if config.token:
            headers["Authorization"] = f"Bearer {config.token}"
        if config.project:
            headers["L3PS-Project"] = config.project
        # A proxy of the environment cannot reach this machine's own loopback interface.
        direct: dict[str, Any] = {"all://127.0.0.1": None, "all://localhost": None, "all://[::1]": None}
        common: dict[str, Any] = {"timeout": timeout, "mounts": direct, "verify": _trusted()}
        self._api = httpx.Client(base_url=config.url, headers=headers, **common)
        # Presigned URLs carry their own credentials; S3 refuses a request that brings a second kind.
        self._objects = httpx.Client(headers={"Accept-Encoding": "identity"}, **common)
        self._bulk = None if getproxies() else httpx.Client(transport=BulkTransport(_trusted()), timeout=timeout)

    def close(self) -> None:
        """Let go of all connections."""
        self._api.close()
        self._objects.close()
        if self._bulk is not None:
            self._bulk.close()

    def get(self, path: str, **params: Any) -> Any:
        """GET a JSON document; parameters that are None are left out."""
        return _document(self.request("GET", path, params=params))

    def get_changed(self, path: str, etag: str | None) -> tuple[Any, str | None]:
        """GET a JSON document and its ETag; the document is None where it is still the one of ``etag``."""
        headers = {"If-None-Match": etag} if etag else {}
        answer = self.request("GET", path, headers=headers)
        return (None if answer.status_code == 304 else _document(answer)), answer.headers.get("etag")

    def post(self, path: str, body: Document | None = None, key: str | None = None) -> Any:
        """POST a JSON document; an ``Idempotency-Key`` makes it safe to send again when the answer is lost."""
        answer = self.request("POST", path, json=body or {}, headers={"Idempotency-Key": key or new_key()})
        return _document(answer) if answer.content else {}

    def put(self, path: str, body: Document, *, method: str = "PUT", if_match: str | None = None) -> Any:
        """PUT or PATCH a JSON document."""
        return _document(self.request(method, path, json=body, headers=_if_match(if_match)))

    def delete(self, path: str, *, if_match: str | None = None) -> None:
        """DELETE a resource."""
        self.request("DELETE", path, headers=_if_match(if_match))

    def request(
        self, method: str, path: str, *, params: Mapping[str, Any] | None = None, **rest: Any
    ) -> httpx.Response:
        """One request to the service, sent again while nobody is harmed by it.

        Every method may be: reads and deletions change nothing a second time, and a POST carries its key.
        """
        given = {name: value for name, value in (params or {}).items() if value is not None}

        def send() -> httpx.Response:
            return self._api.request(method, path, params=given, **rest)

        return self._until_answered(send, self.retry.tries, time.sleep)

    def put_object(self, url: str, content: Callable[[], Iterable[bytes]], length: int, sleep: Sleep) -> httpx.Response:
        """PUT bytes to a presigned URL; ``content`` is called for every try."""

        def send() -> httpx.Response:
            headers = {"Content-Length": str(length)}
            return self._objects.put(self.absolute(url), content=content(), headers=headers)

        return self._until_answered(send, self.retry.tries + 2, sleep)

    @contextmanager
    def open(
        self, url: str, *, presigned: bool, headers: Mapping[str, str] | None = None,
        params: Mapping[str, Any] | None = None, timeout: float | None = None, bulk: bool = False,
    ) -> Iterator[httpx.Response]:  # fmt: skip
        """GET an answer to read piece by piece, once; what goes wrong on the way becomes this package's errors.

        ``bulk`` for one of many megabytes.
        """
        client = self._objects if presigned else self._api
        if bulk and self._bulk is not None:
            headers = {**({} if presigned else self._api.headers), "Accept-Encoding": "identity", **(headers or {})}
            client = self._bulk
        given = {name: value for name, value in (params or {}).items() if value is not None}
        limits = httpx.Timeout(self.timeout, read=timeout or self.timeout)
        try:
            with client.stream(
                "GET", self.absolute(url), params=given or None, headers=dict(headers or {}), timeout=limits
            ) as answer:
                if answer.is_error:
                    answer.read()
                    raise refusal(answer)
                yield answer
        except httpx.TransportError as error:
            raise Unreachable(self._nobody(error)) from error

    def absolute(self, url: str) -> str:
        """A URL of an answer, which may be relative to the service's own."""
        return str(httpx.URL(f"{self.config.url}/").join(url))

    def _until_answered(self, send: Callable[[], httpx.Response], tries: int, sleep: Sleep) -> httpx.Response:
        began, attempt = time.monotonic(), 0
        while True:
            attempt += 1
            last = attempt >= tries
            try:
                answer = send()
            except httpx.TransportError as error:
                if last:
                    raise Unreachable(self._nobody(error)) from error
                sleep(self.retry.pause(attempt))
                continue
            if not answer.is_error:
                return answer
            pause = self._pause_before_repeat(answer, attempt)
            if _in_progress(answer):
                last = time.monotonic() - began >= self.retry.in_progress
                attempt -= 1
            if last or pause is None:
                raise refusal(answer)
            sleep(pause)

    def _pause_before_repeat(self, answer: httpx.Response, attempt: int) -> float | None:
        """Seconds until the same request makes sense again, None where it never will or not soon."""
        after = retry_after(answer)
        if answer.status_code in _LATER or _in_progress(answer):
            pause = self.retry.pause(attempt) if after is None else after
            return pause if pause <= self.retry.longest_wait else None
        return self.retry.pause(attempt) if answer.status_code in _NOT_THE_SERVICE else None

    def _nobody(self, error: Exception) -> str:
        return (
            f"No answer from the service at {self.config.url} ({error}). Start one with `l3ps up`, "
            "or set L3PS_URL to the address of one that runs."
        )


@cache
def _trusted() -> ssl.SSLContext:
    """The certificates to trust; reading them takes 20 ms of CPU time, so all clients of a process share them."""
    return httpx.create_ssl_context()


def new_key() -> str:
    """A fresh ``Idempotency-Key``."""
    return uuid4().hex


def retry_after(answer: httpx.Response) -> float | None:
    """Seconds that an answer asks to wait, by number or date, None where it does not say."""
    value = answer.headers.get("retry-after", "").strip()
    if value.isdigit():
        return float(value)
    with suppress(ValueError):
        when = parsedate_to_datetime(value)
        return max(0.0, (when - datetime.now(when.tzinfo or UTC)).total_seconds())
    return None


def _in_progress(answer: httpx.Response) -> bool:
    """Whether this is the same POST, still being carried out for an answer that was lost: a conflict with a time."""
    return answer.status_code == 409 and retry_after(answer) is not None


def refusal(answer: httpx.Response) -> Exception:
    """The exception for an error answer, whatever its body holds."""
    document: Document = {}
    with suppress(ValueError):
        parsed = answer.json()
        document = parsed if isinstance(parsed, dict) else {}
    if not document:
        document = {"detail": f"{answer.request.url.host} answered {answer.status_code} {answer.reason_phrase}."}
    status = answer.status_code
    if status == 429:
        return TooManyRequests(status, document, retry_after(answer))
    if status in _LATER + _NOT_THE_SERVICE:
        return Unreachable("\n".join(sentences(document)), retry_after(answer))
    return KINDS.get(status, Refused)(status, document)


def _document(answer: httpx.Response) -> Any:
    try:
        return answer.json()
    except ValueError as error:
        what = f"What answers at {answer.request.url} is not the service: it sends {answer.headers.get('content-type')}"
        raise Unreachable(f"{what} instead of JSON. Correct L3PS_URL.") from error


def _if_match(etag: str | None) -> dict[str, str]:
    return {"If-Match": etag} if etag else {}
