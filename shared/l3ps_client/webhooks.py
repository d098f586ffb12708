"""Whether a delivery came from the service, after the Standard Webhooks specification, scheme v1.

The service signs ``{webhook-id}.{webhook-timestamp}.{body}`` with HMAC-SHA256 and the webhook's secret. While a secret
is being rotated a delivery carries a signature of each, so any one that fits will do. The body must be the bytes as
they came: JSON written again is other bytes.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from l3ps_client._errors import L3psClientError

__all__ = ["BadSignature", "Event", "verify"]

_PREFIX = "whsec_"


class BadSignature(L3psClientError):  # noqa: N818
    """A delivery that the service did not send, or not just now: answer 400 and do nothing."""


@dataclass(frozen=True)
class Event:
    """A delivery that is genuine.

    Attributes:
        id: the same for every try of a delivery: whoever has seen it need not act again.
        kind: such as ``job.succeeded``.
        timestamp: when this try was signed.
        data: the event's document.
        document: the whole body.
    """

    id: str
    kind: str
    timestamp: datetime
    data: Any
    document: Any


def verify(payload: bytes, headers: Mapping[str, str], secret: str, tolerance: float = 300.0) -> Event:
    """The event of a delivery; BadSignature where it is none of this webhook's.

    Args:
        payload: the request's body, untouched.
        headers: the request's headers, in any case.
        secret: what creating or rotating the webhook answered, ``whsec_…``.
        tolerance: seconds that the signature may be old, or ahead of this machine's clock.
    """
    given = {name.lower(): value for name, value in headers.items()}
    missing = [name for name in ("webhook-id", "webhook-timestamp", "webhook-signature") if not given.get(name)]
    if missing:
        raise BadSignature(f"The delivery lacks the header {' and '.join(missing)}.")
    identifier, stamp = given["webhook-id"], given["webhook-timestamp"]
    if not (stamp.isascii() and stamp.isdigit() and len(stamp) <= 12):
        raise BadSignature(f"webhook-timestamp {stamp!r} is no time in seconds.")
    expected = hmac.new(_key(secret), f"{identifier}.{stamp}.".encode() + payload, hashlib.sha256).digest()
    # Every signature is looked at, whichever fits, so that the time taken tells nothing.
    fits = [hmac.compare_digest(expected, signature) for signature in _signatures(given["webhook-signature"])]
    if not any(fits):
        raise BadSignature("No signature of the delivery fits this secret and these bytes.")
    age = time.time() - int(stamp)
    if abs(age) > tolerance:
        raise BadSignature(f"The delivery was signed {age:.0f} s ago, more than the {tolerance:g} s tolerated.")
    try:
        document = json.loads(payload)
    except ValueError as error:
        raise BadSignature("The delivery's body is no JSON.") from error
    fields = document if isinstance(document, dict) else {}
    when = datetime.fromtimestamp(int(stamp), UTC)
    return Event(identifier, str(fields.get("type") or ""), when, fields.get("data"), document)


def _key(secret: str) -> bytes:
    try:
        return base64.b64decode(secret.removeprefix(_PREFIX), validate=True)
    except (binascii.Error, ValueError) as error:
        raise ValueError(
            "the secret is no base64 behind whsec_: use the one that the webhook's creation told"
        ) from error


def _signatures(header: str) -> list[bytes]:
    """The signatures of scheme v1 among those of a header, which may name others beside them."""
    found = []
    for word in header.split(" "):
        scheme, _, encoded = word.partition(",")
        if scheme == "v1":
            try:
                found.append(base64.b64decode(encoded, validate=True))
            except (binascii.Error, ValueError):
                continue
    return found
