"""Buckets that others fill: what may be read from where, and a view of them that cannot write.

A source is named in the settings with its credentials; a client names only ``s3://bucket/prefix``, which must lie in a
source by whole path segments.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from typing import BinaryIO, cast
from urllib.parse import parse_qs, unquote, urlsplit

import urllib3
from minio import Minio
from minio.error import InvalidResponseError, MinioException, S3Error, ServerError

from l3ps_platform.errors import ObjectMissing, StoreUnavailable
from l3ps_platform.objects.interface import ObjectInfo
from l3ps_platform.settings import S3Location, Settings

_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")
MAX_REFERENCE = 1024
"""Characters; an S3 key has at most 1024 bytes."""


@dataclass(frozen=True, slots=True)
class Reference:
    """An object or folder in a bucket, as a client names it; ``path`` without slashes at its ends, "" for all."""

    bucket: str
    path: str

    def __str__(self) -> str:
        return f"s3://{self.bucket}/{self.path}" if self.path else f"s3://{self.bucket}"

    @classmethod
    def parse(cls, text: str) -> Reference:
        """Read ``s3://bucket/prefix``. ValueError with a clause that says what is wrong."""
        if not text.startswith("s3://"):
            raise ValueError("it is not of the form s3://bucket/prefix")
        bucket, _, path = text.removeprefix("s3://").partition("/")
        if "@" in bucket:
            raise ValueError("it carries credentials; those belong into the service's settings alone")
        return cls.of(bucket, path.removesuffix("/"))

    @classmethod
    def of(cls, bucket: str, path: str) -> Reference:
        """From its parts. ValueError as above."""
        if not _BUCKET.fullmatch(bucket):
            raise ValueError(f"{bucket[:70]!r} is no name of a bucket")
        if len(path) > MAX_REFERENCE or any(ord(c) < 32 or ord(c) == 127 for c in path):
            raise ValueError("its prefix has control characters or is too long")
        if path and not {"", ".", ".."}.isdisjoint(path.split("/")):
            raise ValueError("its prefix has empty parts, '.' or '..'")
        return cls(bucket, path)

    def within(self, path: str) -> bool:
        """Whether it is this path or lies below it, by whole segments."""
        return not path or self.path == path or self.path.startswith(f"{path}/")


@dataclass(frozen=True, slots=True)
class Source:
    """A place that jobs may read: ``s3://KEY:SECRET@host:port/bucket/prefix?secure=0&project=prj_…``.

    Attributes:
        location: the bucket and how it is reached.
        path: the prefix, without slashes at its ends; "" for the whole bucket.
        project_id: the only project that may use it; None for all.
    """

    location: S3Location
    path: str
    project_id: str | None

    @classmethod
    def parse(cls, url: str) -> Source:
        """Read the URL. ValueError, which never repeats the URL: it holds a secret."""
        parts = urlsplit(url.strip())
        bucket, _, path = parts.path.strip("/").partition("/")
        location = S3Location.parse(parts._replace(path=f"/{bucket}").geturl())
        project = parse_qs(parts.query).get("project", [None])[0]
        return cls(location, Reference.of(bucket, unquote(path).strip("/")).path, project)

    def covers(self, reference: Reference) -> bool:
        """Whether a place lies in it."""
        return reference.bucket == self.location.bucket and reference.within(self.path)

    def lies_in(self, reference: Reference) -> bool:
        """Whether it lies in a place."""
        own = Reference(self.location.bucket, self.path)
        return reference.bucket == own.bucket and own.within(reference.path)

    def admits(self, project_id: str) -> bool:
        """Whether a project may use it."""
        return self.project_id in (None, project_id)


def parse_sources(text: str) -> tuple[Source, ...]:
    """The sources of the settings: a JSON list of URLs, or URLs separated by commas. ValueError without any secret."""
    text = text.strip()
    try:
        urls = json.loads(text) if text.startswith("[") else [part for part in text.split(",") if part.strip()]
    except ValueError:
        raise ValueError("the sources are neither a JSON list nor separated by commas") from None
    sources = []
    for number, url in enumerate(urls, start=1):
        try:
            sources.append(Source.parse(url if isinstance(url, str) else ""))
        except ValueError:
            form = "s3://KEY:SECRET@host:port/bucket/prefix?secure=0&project=prj_…, special characters percent-encoded"
            raise ValueError(f"source {number} is not of the form {form}") from None
    return tuple(sources)


_parsed = lru_cache(maxsize=1)(parse_sources)


def find_source(settings: Settings, reference: Reference, project_id: str) -> Source | None:
    """The source through which a project may read a place; None where there is none.

    The narrowest source around a place decides: what is one project's alone is no other's through a wider source, nor
    as a part of a larger place.
    """
    sources = _parsed(settings.sources.get_secret_value())
    around = [source for source in sources if source.covers(reference)]
    narrowest = max((len(source.path) for source in around), default=0)
    deciding = [source for source in around if len(source.path) == narrowest]
    found = next((source for source in deciding if source.admits(project_id)), None)
    if found is None:
        return None
    inside = [source for source in sources if source.lies_in(reference) and len(source.path) > narrowest]
    closed = {source.path for source in inside} - {source.path for source in inside if source.admits(project_id)}
    return None if closed else found


class SourceStore:
    """A view for reading of what lies below a source's prefix. Keys are the bucket's, whatever they look like."""

    def __init__(self, source: Source) -> None:
        location = source.location
        self._source = source
        self._bucket = location.bucket
        self._client = Minio(
            location.endpoint,
            access_key=location.access_key,
            secret_key=location.secret_key.get_secret_value(),
            secure=location.secure,
            region=location.region,
            http_client=urllib3.PoolManager(
                timeout=urllib3.Timeout(connect=3, read=60),
                retries=urllib3.Retry(total=3, backoff_factor=0.2, status_forcelist=[500, 502, 503, 504]),
            ),
        )

    def find(self, key: str) -> ObjectInfo | None:
        """The object of exactly this key, or None."""
        try:
            with self._errors(key):
                found = self._client.stat_object(self._bucket, self._own(key))
        except ObjectMissing:
            return None
        return _info(key, found.size, found.etag, found.last_modified)

    def walk(self, folder: str) -> Iterator[ObjectInfo]:
        """The objects below a folder in the order of their keys; placeholders of folders are left out."""
        prefix = f"{self._own(folder)}/" if folder else ""
        with self._errors(folder):
            for found in self._client.list_objects(self._bucket, prefix=prefix, recursive=True):
                key = found.object_name or ""
                if not key.endswith("/"):
                    yield _info(key, found.size, found.etag, found.last_modified)

    @contextmanager
    def open(self, key: str) -> Iterator[BinaryIO]:
        """A stream for reading once. ObjectMissing; StoreUnavailable when the connection breaks off."""
        with self._errors(key):
            response = self._client.get_object(self._bucket, self._own(key))
            try:
                yield cast(BinaryIO, response)
            finally:
                response.close()
                response.release_conn()

    def _own(self, key: str) -> str:
        if not Reference(self._bucket, key).within(self._source.path):
            raise ValueError(f"{key!r} lies outside of the source")
        return key

    @contextmanager
    def _errors(self, key: str) -> Iterator[None]:
        place = f"the source s3://{self._bucket}"
        try:
            yield
        except S3Error as error:
            if error.code in ("NoSuchKey", "NoSuchObject"):
                raise ObjectMissing(key) from None
            raise StoreUnavailable(f"{place} refused: {error.code}, {error.message}") from error
        except (ServerError, InvalidResponseError, MinioException, urllib3.exceptions.HTTPError) as error:
            raise StoreUnavailable(f"{place} does not answer: {error}") from error


def _info(key: str, size: int | None, etag: str | None, modified: datetime | None) -> ObjectInfo:
    return ObjectInfo(key, size or 0, (etag or "").strip('"'), modified or datetime.fromtimestamp(0, UTC))
