"""Presigned URLs of an S3 server by hand (AWS Signature Version 4 in the query), because ``minio`` signs no headers.

A signed ``Content-Length`` makes the server refuse a body of another length before it takes a byte of it.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from urllib.parse import quote

from pydantic import SecretStr

MAX_SECONDS = 7 * 24 * 3600
"""S3's limit for the life of a presigned URL."""


@dataclass(frozen=True, slots=True)
class Presigner:
    """Signs for one bucket of one server.

    Attributes:
        base: ``scheme://host[:port]`` as clients reach the server; the signature covers the host.
        bucket: the bucket; it becomes the first part of the path.
        region: the server's.
        access_key, secret_key: the credentials.
    """

    base: str
    bucket: str
    region: str
    access_key: str
    secret_key: SecretStr

    def url(
        self,
        method: str,
        key: str,
        seconds: int,
        *,
        query: Mapping[str, str] | None = None,
        length: int | None = None,
        now: datetime | None = None,
    ) -> str:
        """A URL for one act on one object.

        Args:
            method: HTTP method.
            key: the object.
            seconds: how long the URL is valid; at most a week.
            query: further parameters, which the signature covers.
            length: the only Content-Length it is valid with; None: any.
            now: when it is signed; the clock's time when None.
        """
        moment = (now or datetime.now(UTC)).strftime("%Y%m%dT%H%M%SZ")
        scope = f"{moment[:8]}/{self.region}/s3/aws4_request"
        headers = {"host": self.base.partition("://")[2]}
        if length is not None:
            headers = {"content-length": str(length), **headers}
        parameters = {
            **(query or {}),
            "X-Amz-Algorithm": "AWS4-HMAC-SHA256",
            "X-Amz-Credential": f"{self.access_key}/{scope}",
            "X-Amz-Date": moment,
            "X-Amz-Expires": str(max(1, min(seconds, MAX_SECONDS))),
            "X-Amz-SignedHeaders": ";".join(headers),
        }
        path = quote(f"/{self.bucket}/{key}")
        joined = "&".join(sorted(f"{_quoted(name)}={_quoted(value)}" for name, value in parameters.items()))
        lines = [method, path, joined, *(f"{name}:{value}" for name, value in headers.items())]
        canonical = "\n".join([*lines, "", ";".join(headers), "UNSIGNED-PAYLOAD"])
        digest = hashlib.sha256(canonical.encode()).hexdigest()
        signature = self._sign(f"AWS4-HMAC-SHA256\n{moment}\n{scope}\n{digest}", scope)
        return f"{self.base}{path}?{joined}&X-Amz-Signature={signature}"

    def _sign(self, text: str, scope: str) -> str:
        key = f"AWS4{self.secret_key.get_secret_value()}".encode()
        for step in (*scope.split("/"), text):
            key = hmac.new(key, step.encode(), hashlib.sha256).digest()
        return key.hex()


def _quoted(text: str) -> str:
    return quote(text, safe="-_.~")
