"""Objects of the directory store over HTTP."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import ExitStack

from fastapi.concurrency import run_in_threadpool

from l3ps_api.problems import ApiProblem, invalid, too_large
from l3ps_api.ranges import RangedResponse
from l3ps_api.services import Services
from l3ps_api.uploads.parts import largest_part
from l3ps_platform.objects import DirectoryStore, Grant, Incoming, attachment, content_type

_BLOCK = 1 << 20
"""Bytes collected before they are handed to a thread, which writes and hashes them while the next ones arrive: the
server delivers 64 KB at a time."""


def grant(services: Services, method: str, key: str, query: Mapping[str, str]) -> Grant:
    """What a presigned request may do; InvalidSignature, InvalidKey, or 404 where the objects live elsewhere."""
    return _directory(services).signer.verify(method, key, query)


async def receive(services: Services, grant: Grant, declared: str | None, body: AsyncIterator[bytes]) -> str:
    """Store a body as it arrives; one that is not as announced or breaks off leaves nothing. Returns the etag."""
    limit = largest_part(services.settings) if grant.size is None else grant.size
    length = int(declared) if declared is not None and declared.isdigit() else None
    if length is not None and length > limit:
        raise _too_large(limit)
    if length is not None and grant.size is not None and length < grant.size:
        raise _too_short(length, grant.size)
    with ExitStack() as stack:
        incoming = await run_in_threadpool(stack.enter_context, _directory(services).receive(grant))
        writer = _Writer(incoming)
        try:
            async for chunk in body:
                if writer.size + len(chunk) > limit:
                    raise _too_large(limit)
                await writer.take(chunk)
        finally:
            await writer.finish()
        if length is not None and writer.size != length:
            raise invalid("body", "it broke off before its declared length", "Send it again.")
        if grant.size is not None and writer.size < grant.size:
            raise _too_short(writer.size, grant.size)
        await run_in_threadpool(stack.pop_all().close)  # it waits for the disk
    return incoming.etag


class _Writer:
    """Collects what arrives and has a thread write one block while the next is being collected."""

    def __init__(self, incoming: Incoming) -> None:
        self._incoming = incoming
        self._block = bytearray()
        self._writing: asyncio.Task[None] | None = None
        self.size = 0

    async def take(self, chunk: bytes) -> None:
        self._block += chunk
        self.size += len(chunk)
        if len(self._block) >= _BLOCK:
            await self._write()

    async def finish(self) -> None:
        await self._write()
        await self._written()

    async def _write(self) -> None:
        await self._written()
        if self._block:
            self._writing = asyncio.create_task(run_in_threadpool(self._incoming.write, self._block))
            self._block = bytearray()

    async def _written(self) -> None:
        writing, self._writing = self._writing, None
        if writing is not None:
            await writing


def send(services: Services, grant: Grant) -> RangedResponse:
    """The response that sends an object."""
    store = _directory(services)
    file, info = store.opened(grant.key)

    def read(begin: int, end: int) -> Iterator[bytes]:
        file.seek(begin)
        while begin < end and (block := file.read(min(_BLOCK, end - begin))):
            begin += len(block)
            yield block

    filename = grant.filename or grant.key.rpartition("/")[2]
    # A stored file is data from somewhere: the browser saves it and never renders it under this origin.
    headers = {"X-Content-Type-Options": "nosniff", "Content-Security-Policy": "sandbox"}
    headers["Content-Disposition"] = attachment(filename)
    return RangedResponse(read, info.size, info.etag, content_type(grant.key), headers, close=file.close)


def _directory(services: Services) -> DirectoryStore:
    if isinstance(services.store, DirectoryStore):
        return services.store
    detail = "This service keeps its objects in an S3 server, whose own URLs lead to them."
    raise ApiProblem(404, "not-found", "Not Found", f"{detail} Use those.")


def _too_large(limit: int) -> ApiProblem:
    return too_large("body", f"a part is larger than {limit} bytes", "Send the parts in the size the upload names.")


def _too_short(size: int, announced: int) -> ApiProblem:
    what = f"{size} bytes came, {announced} were announced"
    return invalid("body", what, "Send the part whole, in the size the upload names.", code="wrong-size")
