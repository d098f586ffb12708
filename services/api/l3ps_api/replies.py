"""Requests read and responses held back until they are whole, and questions that the service asks itself."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send

Headers = list[tuple[bytes, bytes]]

_OF_THE_REQUEST = (b"content-length", b"content-type", b"idempotency-key", b"if-match", b"if-none-match", b"range")
_WITHIN = "asked_within"


@dataclass(slots=True)
class Reply:
    """A whole response."""

    status: int = 500
    headers: Headers = field(default_factory=list)
    body: bytes = b""

    def header(self, name: bytes) -> str | None:
        """The first header of this name, in lower case."""
        return header(self.headers, name)

    async def send(self, send: Send) -> None:
        """Answer with it."""
        headers = [(name, value) for name, value in self.headers if name != b"content-length"]
        if self.status not in (204, 304):
            headers.append((b"content-length", str(len(self.body)).encode()))
        await send({"type": "http.response.start", "status": self.status, "headers": headers})
        await send({"type": "http.response.body", "body": self.body})


def header(headers: Headers, name: bytes) -> str | None:
    """The first header of a name, in lower case."""
    return next((value.decode("latin-1") for given, value in headers if given == name), None)


async def read_body(receive: Receive) -> bytes | None:
    """The whole body of a request; None where the client has gone in the middle of it."""
    blocks = []
    while (message := await receive())["type"] == "http.request":
        blocks.append(message.get("body", b""))
        if not message.get("more_body"):
            return b"".join(blocks)
    return None


def again(body: bytes, receive: Receive) -> Receive:
    """A stream of messages that begins with a body that has been read."""
    given = False

    async def replayed() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return replayed


async def hold(
    app: ASGIApp, scope: Scope, receive: Receive, send: Send, wanted: Callable[[Message], bool] = lambda start: True
) -> Reply | None:
    """The response to a request; None where its start is not ``wanted``: then it has been passed on as it came."""
    reply: Reply | None = None

    async def collect(message: Message) -> None:
        nonlocal reply
        if message["type"] == "http.response.start" and wanted(message):
            reply = Reply(message["status"], list(message.get("headers", ())))
        elif reply is None:
            await send(message)
        elif message["type"] == "http.response.body":
            reply.body += message.get("body", b"")

    await app(scope, receive, collect)
    return reply


async def ask(app: ASGIApp, scope: Scope, path: str, *, within: bool = False) -> Reply:
    """The answer that the caller of a request would get to GET ``path``.

    ``within``: asked by one that holds a turn and a transaction, and waits for the answer (:func:`asked_within`).
    """
    headers = [(name, value) for name, value in scope["headers"] if name not in _OF_THE_REQUEST]
    question: dict[str, Any] = {
        **scope, "method": "GET", "path": path, "raw_path": path.encode(), "query_string": b"", "headers": headers,
        "state": {**scope["state"], _WITHIN: within},
    }  # fmt: skip
    given = False

    async def nothing() -> Message:
        nonlocal given
        if given:
            await asyncio.Event().wait()  # whoever listens for the end of the client: it waits for the answer
        given = True
        return {"type": "http.request", "body": b"", "more_body": False}

    async def nowhere(_: Message) -> None:
        return None

    return await hold(app, question, nothing, nowhere) or Reply()


def asked_within(scope: Scope) -> bool:
    """Whether a transaction waits for the answer: to take what those have who wait for that transaction has no end."""
    return bool(scope.get("state", {}).get(_WITHIN))
