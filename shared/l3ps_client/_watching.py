"""Waiting for a job or training: told by its event stream where there is one, else by asking again and again."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator
from contextlib import closing
from typing import Any

from l3ps_client._documents import FINAL
from l3ps_client._errors import Refused, TimedOut, TooManyRequests, Unreachable
from l3ps_client._sse import Event, events
from l3ps_client._wire import Wire

POLL_SECONDS = 0.5
HEARTBEAT_SECONDS = 45.0
"""Without a byte for this long a stream is taken for dead: the service says something every quarter of a minute."""
_PATIENCE_SECONDS = 60.0
"""A service that restarts or is upgraded answers again within this time; until then nobody is told."""
_NO_EVENTS = (404, 405, 406, 422)


class _NothingMoreError(Exception):
    """What was listened to is over, and all of it has been told."""


def watch(
    wire: Wire, resource: str, stream: str | None, timeout: float | None, poll: float | None
) -> Iterator[dict[str, Any]]:
    """The document each time it has changed, the last one when it is over.

    Args:
        wire: the service.
        resource: path of the document.
        stream: path of its events, None where there are none.
        timeout: seconds until TimedOut is raised.
        poll: seconds between two looks, None to be told by events.
    """
    deadline = time.monotonic() + timeout if timeout is not None else float("inf")
    etag: str | None = None
    heard = time.monotonic()
    with closing(_occasions(wire, stream if poll is None else None, deadline, poll or POLL_SECONDS)) as occasions:
        for _ in occasions:
            try:
                document, etag = wire.get_changed(resource, etag)
                heard = time.monotonic()
            except Unreachable:
                if time.monotonic() - heard > _PATIENCE_SECONDS:
                    raise
                document = None
            if document is not None:
                yield document
                if document["state"] in FINAL:
                    return
            if time.monotonic() > deadline:
                raise TimedOut(f"{resource} was not over within {timeout:g} seconds; it goes on. Wait for it again.")


def listen(
    wire: Wire, stream: str, params: dict[str, Any], after: str | None, timeout: float
) -> Iterator[Event | None]:
    """One connection to a stream of events; None for a sign of life. Unreachable when it breaks."""
    headers = {"Accept": "text/event-stream", "Cache-Control": "no-store"} | ({"Last-Event-ID": after} if after else {})
    with wire.open(stream, presigned=False, headers=headers, params=params, timeout=timeout) as answer:
        if answer.status_code == 204:
            raise _NothingMoreError
        if not answer.headers.get("content-type", "").startswith("text/event-stream"):
            raise Refused(406, {"detail": f"{stream} is no stream of events."})
        yield from events(answer.iter_raw())


def follow(wire: Wire, stream: str, params: dict[str, Any], after: str | None) -> Iterator[Event]:
    """Events until there is nothing more to come: a connection that breaks is made again, where it was."""
    attempt = 0
    while True:
        try:
            for event in listen(wire, stream, params, after, HEARTBEAT_SECONDS):
                attempt = 0
                if event is not None:
                    after = event.id or after
                    if event.kind != "open":  # it tells where the stream begins, and nothing that has happened
                        yield event
        except (Unreachable, TooManyRequests) as error:
            attempt += 1
            asked = error.retry_after or 0.0
            if attempt > wire.retry.tries + 2 or asked > wire.retry.longest_wait:
                raise
            time.sleep(max(asked, wire.retry.pause(attempt)))
        except _NothingMoreError:
            return
        else:
            # In good order, as when the service stops, or because there will be no more: that the next try tells.
            time.sleep(wire.retry.pause(1))


def _occasions(wire: Wire, stream: str | None, deadline: float, poll: float) -> Generator[None, None, None]:
    """Each time that looking makes sense: now, when something happened, when the stream ended, at the deadline."""
    yield
    after: str | None = None
    not_before = 0.0
    while True:
        left = max(deadline - time.monotonic(), 0.01)
        if stream is None or time.monotonic() < not_before:
            time.sleep(min(poll, left))
            yield
            continue
        looked = time.monotonic()
        try:
            for event in listen(wire, stream, {}, after, min(left, HEARTBEAT_SECONDS)):
                after = (event.id or after) if event is not None else after
                # A worker tells of each scan; nobody reads that fast.
                if time.monotonic() - looked >= POLL_SECONDS:
                    yield
                    looked = time.monotonic()
        except (Unreachable, TooManyRequests) as error:
            not_before = time.monotonic() + max(error.retry_after or 0.0, POLL_SECONDS)  # until then it is asked
        except Refused as error:
            if error.status not in _NO_EVENTS:
                raise
            stream = None
        except _NothingMoreError:
            stream = None
        else:
            yield
            time.sleep(min(wire.retry.pause(1), left))
        yield
