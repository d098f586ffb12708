"""The object store on any S3 server, through the ``minio`` client."""

from __future__ import annotations

import io
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO, cast

import urllib3
from minio import Minio
from minio.datatypes import Part as MinioPart
from minio.deleteobjects import DeleteObject
from minio.error import InvalidResponseError, MinioException, S3Error, ServerError
from urllib3.response import BaseHTTPResponse

from l3ps_platform.errors import ObjectMissing, StoreUnavailable, UploadError
from l3ps_platform.objects.interface import GONE, ObjectInfo, Part, Pending
from l3ps_platform.objects.keys import attachment, check_key, check_prefix, content_type
from l3ps_platform.objects.presign import Presigner
from l3ps_platform.objects.s3_stream import S3Stream
from l3ps_platform.settings import S3Location

_CHUNK = 1 << 20
_BAD_PARTS = {"InvalidPart", "InvalidPartOrder", "EntityTooSmall", "MalformedXML", "InvalidArgument"}


class S3Store:
    """Objects in one bucket.

    Args:
        location: the bucket and how the services reach it.
        public_url: ``scheme://host:port`` under which clients reach the same server, where that differs; presigned
            URLs are signed for it, because a signature covers the host name.
    """

    def __init__(self, location: S3Location, public_url: str | None = None) -> None:
        self._bucket = location.bucket
        self._where = f"{location.endpoint}/{location.bucket}"
        self._client = _client(location)
        base = public_url or f"{'https' if location.secure else 'http'}://{location.endpoint}"
        credentials = location.region, location.access_key, location.secret_key
        self._presigner = Presigner(base.rstrip("/"), location.bucket, *credentials)

    def ensure(self) -> None:
        """Create the bucket if it is missing."""
        with self._errors():
            if not self._client.bucket_exists(self._bucket):
                try:
                    self._client.make_bucket(self._bucket)
                except S3Error as error:
                    if error.code not in ("BucketAlreadyOwnedByYou", "BucketAlreadyExists"):
                        raise

    def ping(self) -> None:
        """Raise StoreUnavailable unless the server answers and the bucket is there."""
        with self._errors():
            if not self._client.bucket_exists(self._bucket):
                raise StoreUnavailable(f"the object store has no bucket {self._where}")

    def put_file(self, key: str, path: Path) -> None:
        """Store a file; large ones go in parts."""
        with self._errors(key):
            self._client.fput_object(self._bucket, check_key(key), str(path), content_type=content_type(key))

    def put_bytes(self, key: str, data: bytes) -> None:
        """Store bytes."""
        with self._errors(key):
            self._client.put_object(
                self._bucket, check_key(key), io.BytesIO(data), len(data), content_type=content_type(key)
            )

    def get_file(self, key: str, path: Path) -> None:
        """Fetch an object into a file."""
        partial = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
        try:
            with self.open(key) as source, partial.open("wb") as file:
                shutil.copyfileobj(source, file, _CHUNK)
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)

    def get_bytes(self, key: str, offset: int = 0, length: int | None = None) -> bytes:
        """The object's bytes from ``offset`` on, at most ``length`` of them."""
        if length == 0:
            return b""
        with self._stream(key, offset, length) as stream:
            return stream.read()

    def open(self, key: str, offset: int = 0) -> AbstractContextManager[BinaryIO]:
        """A stream for reading; it goes on by itself where a connection breaks off."""
        return self._stream(key, offset)

    @contextmanager
    def _stream(self, key: str, offset: int, length: int | None = None) -> Iterator[BinaryIO]:
        def fetch(at: int, etag: str | None) -> BaseHTTPResponse:
            condition: dict[str, str | list[str] | tuple[str]] = {} if etag is None else {"If-Match": etag}
            rest = 0 if length is None else offset + length - at
            with self._errors(key):
                return self._client.get_object(
                    self._bucket, key, offset=at, length=rest, request_headers=condition
                )  # fmt: skip

        check_key(key)
        try:
            stream = S3Stream(repr(key), fetch, offset)
        except _BeyondEnd:
            yield io.BytesIO()
            return
        with io.BufferedReader(stream, _CHUNK) as buffered:
            yield cast(BinaryIO, buffered)

    def stat(self, key: str) -> ObjectInfo:
        """Size, etag and age."""
        with self._errors(key):
            found = self._client.stat_object(self._bucket, check_key(key))
            return _info(key, found.size, found.etag, found.last_modified)

    def exists(self, key: str) -> bool:
        """Whether there is such an object."""
        try:
            self.stat(key)
        except ObjectMissing:
            return False
        return True

    def list(self, prefix: str = "") -> Iterator[ObjectInfo]:
        """All objects below ``prefix``, in the order of their keys."""
        with self._errors():
            for found in self._client.list_objects(self._bucket, prefix=check_prefix(prefix), recursive=True):
                yield _info(found.object_name or "", found.size, found.etag, found.last_modified)

    def delete(self, key: str) -> None:
        """Delete an object."""
        with self._errors(key):
            self._client.remove_object(self._bucket, check_key(key))

    def delete_prefix(self, prefix: str) -> int:
        """Delete all objects below ``prefix``."""
        keys = [info.key for info in self.list(prefix)]
        with self._errors():
            for error in self._client.remove_objects(self._bucket, [DeleteObject(key) for key in keys]):
                raise StoreUnavailable(f"the object store did not delete {error.name!r}: {error.message}")
        return len(keys)

    def presign_get(self, key: str, seconds: int, filename: str | None = None) -> str:
        """A URL that downloads the object."""
        query = {}
        if filename is not None:
            query["response-content-disposition"] = attachment(filename)
        return self._presigner.url("GET", check_key(key), seconds, query=query)

    def presign_put(self, key: str, seconds: int) -> str:
        """A URL that stores the body of one PUT."""
        return self._presigner.url("PUT", check_key(key), seconds)

    # minio-py has no public face for the steps of a multipart upload; the underscored methods have been stable
    # since 7.0 and the dependency is held below 7.3.

    def create_multipart(self, key: str, part_size: int) -> str:
        """Begin a multipart upload."""
        with self._errors(key):
            return self._client._create_multipart_upload(
                self._bucket, check_key(key), {"Content-Type": content_type(key)}
            )

    def presign_part(self, key: str, upload_id: str, number: int, seconds: int, size: int | None = None) -> str:
        """A URL that stores the body of one PUT as a part."""
        query = {"uploadId": upload_id, "partNumber": str(number)}
        return self._presigner.url("PUT", check_key(key), seconds, query=query, length=size)

    def list_parts(self, key: str, upload_id: str) -> Sequence[Part]:
        """The parts that have arrived."""
        found: list[Part] = []
        marker, more = None, True
        while more:
            with self._errors(key):
                page = self._client._list_parts(self._bucket, check_key(key), upload_id, part_number_marker=marker)
            found += [Part(part.part_number, part.etag.strip('"'), part.size) for part in page.parts]
            marker, more = page.next_part_number_marker, page.is_truncated
        return sorted(found, key=lambda part: part.number)

    def list_multipart(self) -> Iterator[Pending]:
        """Multipart uploads in progress, the first thousand (MinIO knows no paging here, and no prefix)."""
        with self._errors():
            page = self._client._list_multipart_uploads(self._bucket)
        for upload in page.uploads:
            begun = upload.initiated_time or datetime.now(UTC)
            yield Pending(upload.object_name, upload.upload_id or "", begun)

    def complete_multipart(self, key: str, upload_id: str, parts: Sequence[Part]) -> ObjectInfo:
        """Join the parts in the order of their numbers."""
        ordered = sorted(parts, key=lambda part: part.number)
        if not ordered or len({part.number for part in ordered}) != len(ordered):
            raise UploadError("an upload is completed with each of its parts once")
        with self._errors(key):
            self._client._complete_multipart_upload(
                self._bucket, check_key(key), upload_id, [MinioPart(p.number, p.etag.strip('"')) for p in ordered]
            )
        try:
            return self.stat(key)
        except ObjectMissing:  # S3 may answer 200 and then report a failure in the body
            raise StoreUnavailable(f"the object store {self._where} did not join the parts of {key!r}") from None

    def abort_multipart(self, key: str, upload_id: str) -> None:
        """Drop an upload and its parts."""
        try:
            with self._errors(key):
                self._client._abort_multipart_upload(self._bucket, check_key(key), upload_id)
        except UploadError:
            pass

    def tidy(self, before: datetime) -> int:
        """Nothing: a server tidies up after itself."""
        return 0

    @contextmanager
    def _errors(self, key: str = "") -> Iterator[None]:
        """Say every failure in the project's own errors."""
        try:
            yield
        except S3Error as error:
            if error.code in ("NoSuchKey", "NoSuchObject"):
                raise ObjectMissing(key) from None
            if error.code == "NoSuchUpload":
                raise UploadError(GONE) from None
            if error.code == "InvalidRange":
                raise _BeyondEnd from None
            if error.code in _BAD_PARTS:
                raise UploadError(f"the parts do not make an object ({error.message}): upload them again") from None
            raise StoreUnavailable(f"the object store {self._where} refused: {error.code}, {error.message}") from error
        except (ServerError, InvalidResponseError, MinioException, urllib3.exceptions.HTTPError) as error:
            raise StoreUnavailable(f"the object store {self._where} does not answer: {error}") from error


class _BeyondEnd(StoreUnavailable):
    """A range that begins at or beyond the end of the object."""


def _client(location: S3Location) -> Minio:
    # minio-py's own pool waits five minutes and tries five times: a dead server would hold a worker for long. Here one
    # that answers nothing at all is given up after a minute and a half, one that refuses connections within seconds.
    retries = urllib3.Retry(total=3, read=2, backoff_factor=0.2, status_forcelist=[500, 502, 503, 504])
    timeout = urllib3.Timeout(connect=3, read=30)
    return Minio(
        location.endpoint,
        access_key=location.access_key,
        secret_key=location.secret_key.get_secret_value(),
        secure=location.secure,
        region=location.region,  # given, so that no request is needed to find out
        http_client=urllib3.PoolManager(timeout=timeout, retries=retries, maxsize=8),
    )


def _info(key: str, size: int | None, etag: str | None, modified: datetime | None) -> ObjectInfo:
    return ObjectInfo(key, size or 0, (etag or "").strip('"'), modified or datetime.fromtimestamp(0, UTC))
