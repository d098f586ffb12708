"""Presigned URLs of the directory store: ``/v1/objects/{key}`` with an HMAC over all that the URL permits."""

from __future__ import annotations

import hashlib
import hmac
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal
from urllib.parse import quote, urlencode

from l3ps_platform.errors import InvalidSignature
from l3ps_platform.objects.keys import check_key

Method = Literal["GET", "PUT"]
OBJECTS_PATH = "/v1/objects/"


@dataclass(frozen=True, slots=True)
class Grant:
    """What a presigned URL permits.

    Attributes:
        method: GET or PUT; a GET grant also covers HEAD.
        key: the object.
        upload_id: the multipart upload, for a PUT of a part.
        part: the part's number, from 1.
        size: bytes that the body of a PUT must have, where that is fixed.
        filename: what the browser should save a download as.
    """

    method: Method
    key: str
    upload_id: str | None = None
    part: int | None = None
    size: int | None = None
    filename: str | None = None


class Signer:
    """Signs and verifies.

    Args:
        secret: the HMAC key; all processes of one store share it.
        base_url: where clients reach the API, without a trailing slash.
    """

    def __init__(self, secret: bytes, base_url: str) -> None:
        self._secret = secret
        self._base_url = base_url

    def url(self, grant: Grant, seconds: int, *, now: float | None = None) -> str:
        """The URL for a grant, valid for ``seconds``."""
        expires = int((time.time() if now is None else now) + seconds)
        query: dict[str, str] = {"expires": str(expires)}
        if grant.upload_id is not None:
            query |= {"upload": grant.upload_id, "part": str(grant.part)}
        if grant.size is not None:
            query["size"] = str(grant.size)
        if grant.filename is not None:
            query["filename"] = grant.filename
        query["signature"] = self._signature(grant, expires)
        return f"{self._base_url}{OBJECTS_PATH}{quote(grant.key)}?{urlencode(query)}"

    def verify(self, method: str, key: str, query: Mapping[str, str], *, now: float | None = None) -> Grant:
        """The grant behind a request.

        Args:
            method: the request's method.
            key: the path after ``/v1/objects/``, unquoted.
            query: the query's parameters.
            now: seconds since the epoch; the clock's when None.

        Raises:
            InvalidSignature: forged, altered, for another method, or out of date.
            InvalidKey: no key of any object.
        """
        check_key(key)
        verb: Method = "PUT" if method == "PUT" else "GET"
        try:
            expires = int(query["expires"])
            part = int(query["part"]) if "upload" in query else None
            size = int(query["size"]) if "size" in query else None
            signature = query["signature"]
        except (KeyError, ValueError):
            raise InvalidSignature("this URL is not presigned: ask the API for one") from None
        grant = Grant(verb, key, query.get("upload"), part, size, query.get("filename"))
        if method not in ("GET", "HEAD", "PUT") or not hmac.compare_digest(
            self._signature(grant, expires).encode(), signature.encode("utf-8", "replace")
        ):
            raise InvalidSignature("the signature does not cover this request: ask the API for a new URL")
        if expires < (time.time() if now is None else now):
            raise InvalidSignature("this URL has expired: ask the API for a new one")
        return grant

    def _signature(self, grant: Grant, expires: int) -> str:
        size = "" if grant.size is None else str(grant.size)
        fields = (grant.method, grant.key, str(expires), grant.upload_id or "", str(grant.part or ""), size)
        # Each field with its length: no two grants share a text.
        text = "".join(f"{len(field)}:{field}" for field in (*fields, grant.filename or ""))
        return hmac.new(self._secret, text.encode(), hashlib.sha256).hexdigest()
