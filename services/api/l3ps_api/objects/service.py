"""Objects of the directory store over HTTP."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from contextlib import ExitStack

from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse

from l3ps_api.problems import ApiProblem, invalid, too_large
from l3ps_api.services import Services
from l3ps_api.uploads.parts import largest_part
from l3ps_platform.objects import DirectoryStore, Grant, content_type

_BLOCK = 1 << 20
"""Bytes collected before they are handed to a thread: the server delivers 64 KB at a time."""


def grant(services: Services, method: str, key: str, query: Mapping[str, str]) -> Grant:
    """What a presigned request may do; InvalidSignature, InvalidKey, or 404 where the objects live elsewhere."""
    return _directory(services).signer.verify(method, key, query)


async def receive(services: Services, grant: Grant, declared: str | None, body: AsyncIterator[bytes]) -> str:
    """Store a body as it arrives; a body that is too large or breaks off leaves nothing. Returns the etag."""
    limit = largest_part(services.settings)
    if declared is not None and declared.isdigit() and int(declared) > limit:
        raise _too_large(limit)
    with ExitStack() as stack:
        incoming = await run_in_threadpool(stack.enter_context, _directory(services).receive(grant))
        block = bytearray()
        async for chunk in body:
            block += chunk
            if incoming.size + len(block) > limit:
                raise _too_large(limit)
            if len(block) >= _BLOCK:
                await run_in_threadpool(incoming.write, bytes(block))
                block.clear()
        if declared is not None and declared.isdigit() and incoming.size + len(block) != int(declared):
            raise invalid("body", "it broke off before its declared length", "Send it again.")
        await run_in_threadpool(incoming.write, bytes(block))
        await run_in_threadpool(stack.pop_all().close)  # it waits for the disk
    return incoming.etag


def send(services: Services, grant: Grant) -> FileResponse:
    """The response that sends an object."""
    path = _directory(services).path_of(grant.key)
    return FileResponse(
        path,
        media_type=content_type(grant.key),
        filename=grant.filename or grant.key.rpartition("/")[2],
        # A stored file is data from somewhere: the browser saves it and never renders it under this origin.
        headers={"X-Content-Type-Options": "nosniff", "Content-Security-Policy": "sandbox"},
    )


def _directory(services: Services) -> DirectoryStore:
    if isinstance(services.store, DirectoryStore):
        return services.store
    detail = "This service keeps its objects in an S3 server, whose own URLs lead to them."
    raise ApiProblem(404, "not-found", "Not Found", f"{detail} Use those.")


def _too_large(limit: int) -> ApiProblem:
    return too_large("body", f"a part is larger than {limit} bytes", "Send the parts in the size the upload names.")
