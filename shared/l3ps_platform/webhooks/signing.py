"""Signatures after Standard Webhooks 1.0 (symmetric, HMAC-SHA256).

Signed is ``ID.TIMESTAMP.BODY``, so that neither can be exchanged and an old message cannot be sent again later. Ten
lines of the standard library: the reference package brings an HTTP client's types and only adds the header names.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import secrets
from collections.abc import Sequence

PREFIX = "whsec_"
SECRET_BYTES = 32
"""The specification asks for 24 to 64."""


def new_secret() -> str:
    """A fresh secret as receivers are given it: ``whsec_`` and base64."""
    return PREFIX + base64.b64encode(secrets.token_bytes(SECRET_BYTES)).decode()


def sign(secret: str, id: str, timestamp: int, body: bytes) -> str:
    """The signature of a message, ``v1,`` and base64.

    Args:
        secret: with or without its prefix. ValueError when it is no base64.
        id: of the message, the same at every attempt.
        timestamp: of the attempt, seconds since 1970.
        body: exactly as sent.
    """
    try:
        key = base64.b64decode(secret.removeprefix(PREFIX), validate=True)
    except binascii.Error as error:
        raise ValueError("a webhook's secret is whsec_ and base64") from error
    digest = hmac.new(key, f"{id}.{timestamp}.".encode() + body, hashlib.sha256).digest()
    return "v1," + base64.b64encode(digest).decode()


def headers(secrets: Sequence[str], id: str, timestamp: int, body: bytes) -> dict[str, str]:
    """The specification's three headers; with one signature for each secret, while an old one is still honoured."""
    return {
        "webhook-id": id,
        "webhook-timestamp": str(timestamp),
        "webhook-signature": " ".join(sign(secret, id, timestamp, body) for secret in secrets),
    }
