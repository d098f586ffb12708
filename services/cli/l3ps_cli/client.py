"""The REST API as the commands use it: one class, every failure one of two exceptions.

ServiceUnreachableError   nobody answers, or the service cannot reach what it needs
ServiceProblemError       the service refused; carries its problem document
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx

DEFAULT_URL = "http://127.0.0.1:8080"
_TRIES = 4
_CHUNK = 1 << 18
_PARALLEL_PARTS = 4
_BUSY = (429, 503)  # the service did nothing and says when to come back
_NOT_THE_SERVICE = (502, 504)  # a proxy that found nobody behind it

Document = dict[str, Any]


class ServiceUnreachableError(Exception):
    """The service does not answer, or says that it cannot work just now."""


class ServiceProblemError(Exception):
    """The service refused a request.

    Attributes:
        status: HTTP status.
        document: its problem document (RFC 9457).
    """

    def __init__(self, status: int, document: Document) -> None:
        self.status, self.document = status, document
        super().__init__("\n".join(sentences(document)))


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


class Client:
    """A connection to one running service.

    Args:
        url: base address; default ``L3PS_URL``, else the loopback default of ``l3ps up``.
        token: bearer token; default ``L3PS_TOKEN``.
        timeout: seconds without a byte before an answer is given up.
    """

    def __init__(self, url: str | None = None, token: str | None = None, timeout: float = 60.0) -> None:
        self.url = (url or os.environ.get("L3PS_URL") or DEFAULT_URL).rstrip("/")
        token = token or os.environ.get("L3PS_TOKEN")
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._api = httpx.Client(base_url=self.url, headers=headers, timeout=timeout)
        # Presigned URLs carry their own credentials; S3 refuses a request that brings a second kind.
        self._objects = httpx.Client(timeout=timeout)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self._api.close()
        self._objects.close()

    def get(self, path: str, **params: str | int | None) -> Document:
        """GET a JSON document under /v1."""
        given = {name: value for name, value in params.items() if value is not None}
        return self._json(self._api, "GET", f"/v1{path}", params=given)

    def post(self, path: str, body: Document | None = None) -> Document:
        """POST a JSON document under /v1. Not repeated once the service may have acted on it."""
        return self._json(self._api, "POST", f"/v1{path}", json=body or {})

    def delete(self, path: str) -> None:
        """DELETE a resource under /v1."""
        self._send(self._api, "DELETE", f"/v1{path}")

    def upload(
        self, file: Path, kind: str, sha256: str, name: str, report: Callable[[int], None] = lambda sent: None
    ) -> Document:
        """Send a file in parts to its presigned URLs and complete the upload.

        Args:
            file: the archive.
            kind: ``drive``, ``model`` or ``annotations``.
            sha256: hex digest of the file.
            name: what the drive, model or annotations are to be called.
            report: called with bytes newly sent (negative when a part starts over), from several threads.

        Returns:
            The document of what was uploaded.
        """
        opened = self.post(
            "/uploads", {"kind": kind, "filename": file.name, "size": file.stat().st_size, "sha256": sha256}
        )
        try:
            with ThreadPoolExecutor(_PARALLEL_PARTS) as pool:
                size = int(opened["part_size"])
                parts = list(pool.map(lambda part: self._put_part(file, part, size, report), opened["parts"]))
        except BaseException:
            with suppress(ServiceProblemError, ServiceUnreachableError):
                self.delete(f"/uploads/{opened['id']}")
            raise
        return self.post(f"/uploads/{opened['id']}/complete", {"parts": parts, "name": name})

    def fetch(self, url: str, target: Path, report: Callable[[int], None] = lambda received: None) -> None:
        """Download a presigned URL into a file; the file appears only when whole."""
        partial = target.with_name(target.name + ".part")
        for attempt in range(1, _TRIES + 1):
            try:
                self._receive(url, partial, report)
                break
            except httpx.TransportError as error:
                report(-partial.stat().st_size if partial.exists() else 0)
                partial.unlink(missing_ok=True)
                if attempt == _TRIES:
                    raise ServiceUnreachableError(self._unreachable(error)) from error
                time.sleep(_pause(attempt))
        partial.replace(target)

    def _receive(self, url: str, partial: Path, report: Callable[[int], None]) -> None:
        with self._objects.stream("GET", self._absolute(url)) as answer:
            if answer.is_error:
                answer.read()
                raise _refusal(answer)
            with partial.open("wb", buffering=0) as file:
                for block in answer.iter_bytes(_CHUNK):
                    file.write(block)
                    report(len(block))

    def _put_part(self, file: Path, part: Document, size: int, report: Callable[[int], None]) -> Document:
        number = int(part["number"])
        start = (number - 1) * size
        length = min(size, file.stat().st_size - start)

        sent = 0

        def blocks() -> Iterator[bytes]:
            nonlocal sent
            report(-sent)  # a part that starts over
            sent = 0
            with file.open("rb") as source:
                source.seek(start)
                while sent < length:
                    block = source.read(min(_CHUNK, length - sent))
                    yield block
                    sent += len(block)
                    report(len(block))

        headers = {"Content-Length": str(length)}
        answer = self._send(
            self._objects, "PUT", self._absolute(part["url"]), content=blocks, headers=headers, repeat=True
        )
        return {"number": number, "etag": answer.headers["etag"].strip('"')}

    def _absolute(self, url: str) -> str:
        return str(httpx.URL(self.url).join(url))

    def _json(self, client: httpx.Client, method: str, url: str, **request: Any) -> Document:
        answer = self._send(client, method, url, repeat=method == "GET", **request)
        return dict(answer.json())

    def _send(
        self, client: httpx.Client, method: str, url: str, *, content: Callable[[], Any] | None = None,
        repeat: bool = False, **request: Any,
    ) -> httpx.Response:  # fmt: skip
        """One request, tried again while nobody is harmed by it: it never arrived, or repeating changes nothing."""
        for attempt in range(1, _TRIES + 1):
            body = {"content": content()} if content else {}
            try:
                answer = client.request(method, url, **request, **body)
            except httpx.TransportError as error:
                if attempt == _TRIES or not (repeat or isinstance(error, httpx.ConnectError)):
                    raise ServiceUnreachableError(self._unreachable(error)) from error
                time.sleep(_pause(attempt))
                continue
            if answer.status_code in _BUSY and attempt < _TRIES:
                time.sleep(min(float(answer.headers.get("retry-after", "1")), 5.0))
                continue
            if answer.is_error:
                raise _refusal(answer)
            return answer
        raise AssertionError("unreachable")

    def _unreachable(self, error: Exception) -> str:
        return (
            f"No answer from the service at {self.url} ({error}). Start one with `l3ps up`, "
            "or set L3PS_URL to the address of one that runs."
        )


def _pause(attempt: int) -> float:
    """Seconds before the next try: 0.2, 0.4, 0.8."""
    return 0.1 * float(2**attempt)


def _refusal(answer: httpx.Response) -> Exception:
    """The exception for an error answer, whatever its body holds."""
    document: Document = {}
    with suppress(ValueError):
        parsed = answer.json()
        document = parsed if isinstance(parsed, dict) else {}
    if not document:
        document = {"detail": f"{answer.request.url.host} answered {answer.status_code} {answer.reason_phrase}."}
    if answer.status_code in _BUSY + _NOT_THE_SERVICE:
        return ServiceUnreachableError("\n".join(sentences(document)))
    return ServiceProblemError(answer.status_code, document)
