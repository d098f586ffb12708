"""One attempt at a delivery: a signed POST in which the receiver decides nothing but the answer's status.

Its time is bounded as a whole (also for one that sends a byte a second), its answer is read no further than
``MAX_ANSWER`` bytes, redirects are an answer like any other, and no proxy of the environment stands between: the
connection goes to the address that the guard has looked at.
"""

from __future__ import annotations

import asyncio
import ssl
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from importlib.metadata import version

import certifi
import httpx
import structlog

from l3ps_platform.errors import TargetRefused
from l3ps_platform.webhooks import signing
from l3ps_platform.webhooks.guard import Guard, Target, host_of
from l3ps_platform.webhooks.schedule import read_retry_after

log = structlog.get_logger(__name__)

MAX_ANSWER = 4096
MAX_TRIED = 3
"""Of a host's addresses, those that are tried where one does not take the connection."""


@dataclass(frozen=True, slots=True)
class Answer:
    """How an attempt ended.

    Attributes:
        status: of the HTTP answer; None where there was none.
        error: what went wrong, one sentence; None when the receiver took the message.
        retry_after: how long the receiver asks to be left alone.
        seconds: what it took.
        timed_out: it was given up at the end of its time.
    """

    status: int | None = None
    error: str | None = None
    retry_after: timedelta | None = None
    seconds: float = 0.0
    timed_out: bool = False

    @property
    def delivered(self) -> bool:
        """Whether the receiver took the message."""
        return self.error is None

    @property
    def gone(self) -> bool:
        """Whether the receiver wants no more messages."""
        return self.status == 410


async def attempt(guard: Guard, url: str, secrets: Sequence[str], id: str, body: bytes, seconds: float) -> Answer:
    """Send a message once.

    Args:
        guard: what may be reached.
        url: of the webhook.
        secrets: to sign with, one signature each.
        id: of the message.
        body: JSON.
        seconds: for everything together, from resolving the name to the end of the answer.

    Returns:
        How it ended, whatever went wrong: what is not counted as an attempt would be made again for ever.
    """
    start = time.monotonic()
    try:
        headers = {
            "content-type": "application/json",
            "accept-encoding": "identity",
            "user-agent": f"l3ps-webhooks/{version('l3ps-platform')}",
            **signing.headers(secrets, id, int(time.time()), body),
        }
        async with asyncio.timeout(seconds):
            target = await asyncio.to_thread(guard.admit, url)
            answer = await _post(target, headers, body, seconds)
    except TargetRefused as refusal:
        answer = Answer(error=f"not sent: {refusal.what}")
    except (TimeoutError, httpx.TimeoutException):
        answer = Answer(error=f"no complete answer within {seconds:g} s", timed_out=True)
    except (httpx.HTTPError, ssl.SSLError, OSError) as error:
        answer = Answer(error=f"{type(error).__name__}: {error}"[:200])
    except Exception as error:
        log.exception("delivery failed in an unforeseen way", delivery=id)
        answer = Answer(error=f"not sent: the service failed ({type(error).__name__})")
    return replace(answer, seconds=time.monotonic() - start)


async def _post(target: Target, headers: Mapping[str, str], body: bytes, seconds: float) -> Answer:
    named = {**headers, "host": target.url.netloc.decode("ascii")}
    # The certificate is checked against the name too.
    extensions = {"sni_hostname": host_of(target.url).rstrip(".")}
    async with httpx.AsyncClient(verify=_tls(), timeout=seconds, trust_env=False, follow_redirects=False) as client:
        *others, last = target.addresses[:MAX_TRIED]
        for address in (*others, last):
            request = client.build_request(
                "POST", target.at(address), headers=named, content=body, extensions=extensions
            )
            try:
                response = await client.send(request, stream=True)
            except (httpx.ConnectError, httpx.ConnectTimeout):
                if address is last:
                    raise
                continue
            try:
                return await _read(response)
            finally:
                await response.aclose()
    raise AssertionError("a target has an address")


async def _read(response: httpx.Response) -> Answer:
    received = 0
    async for chunk in response.aiter_raw():
        received += len(chunk)
        if received >= MAX_ANSWER:
            break
    status = response.status_code
    if 200 <= status < 300:
        return Answer(status)
    asked = response.headers.get("retry-after") if status in (429, 503) else None
    hint = "; redirects are not followed" if 300 <= status < 400 else ""
    return Answer(status, f"the receiver answered {status}{hint}", read_retry_after(asked, datetime.now(UTC)))


@cache
def _tls() -> ssl.SSLContext:
    # The system's authorities (a company may have its own) and the well-known ones (an image may have none).
    context = ssl.create_default_context()
    context.load_verify_locations(certifi.where())
    return context
