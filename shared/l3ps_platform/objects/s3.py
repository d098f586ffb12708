"""The object store on any S3 server, through the ``minio`` client."""

from __future__ import annotations

import io
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import BinaryIO, cast
from urllib.parse import quote, urlsplit

import urllib3
from minio import Minio
from minio.datatypes import Part as MinioPart
from minio.deleteobjects import DeleteObject
from minio.error import InvalidResponseError, MinioException, S3Error, ServerError

from l3ps_platform.errors import ObjectMissing, StoreUnavailable, UploadError
from l3ps_platform.objects.interface import ObjectInfo, Part
from l3ps_platform.objects.keys import check_key, check_prefix, content_type
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
        self._client = _client(location, location.endpoint, location.secure)
        self._public = self._client
        if public_url:
            parts = urlsplit(public_url)
            self._public = _client(location, parts.netloc, parts.scheme == "https")

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
        with self._errors(key):
            response = self._client.get_object(self._bucket, check_key(key), offset=offset, length=length or 0)
            try:
                return response.read()
            finally:
                response.close()
                response.release_conn()

    @contextmanager
    def open(self, key: str) -> Iterator[BinaryIO]:
        """A stream for reading; StoreUnavailable when the connection breaks off before the end."""
        with self._errors(key):
            response = self._client.get_object(self._bucket, check_key(key))
            try:
                yield cast(BinaryIO, response)
            finally:
                response.close()
                response.release_conn()

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
        headers: dict[str, str | list[str] | tuple[str]] | None = None
        if filename is not None:
            headers = {"response-content-disposition": f"attachment; filename*=UTF-8''{quote(filename)}"}
        return self._public.get_presigned_url(
            "GET", self._bucket, check_key(key), timedelta(seconds=seconds), response_headers=headers
        )

    def presign_put(self, key: str, seconds: int) -> str:
        """A URL that stores the body of one PUT."""
        return self._public.get_presigned_url("PUT", self._bucket, check_key(key), timedelta(seconds=seconds))

    # minio-py has no public face for the steps of a multipart upload; the underscored methods have been stable
    # since 7.0 and the dependency is held below 7.3.

    def create_multipart(self, key: str) -> str:
        """Begin a multipart upload."""
        with self._errors(key):
            return self._client._create_multipart_upload(
                self._bucket, check_key(key), {"Content-Type": content_type(key)}
            )

    def presign_part(self, key: str, upload_id: str, number: int, seconds: int) -> str:
        """A URL that stores the body of one PUT as a part."""
        return self._public.get_presigned_url(
            "PUT",
            self._bucket,
            check_key(key),
            timedelta(seconds=seconds),
            extra_query_params={"uploadId": upload_id, "partNumber": str(number)},
        )

    def complete_multipart(self, key: str, upload_id: str, parts: Sequence[Part]) -> ObjectInfo:
        """Join the parts in the order of their numbers."""
        ordered = sorted(parts, key=lambda part: part.number)
        if not ordered or len({part.number for part in ordered}) != len(ordered):
            raise UploadError("an upload is completed with each of its parts once")
        with self._errors(key):
            self._client._complete_multipart_upload(
                self._bucket, check_key(key), upload_id, [MinioPart(p.number, p.etag.strip('"')) for p in ordered]
            )
        return self.stat(key)

    def abort_multipart(self, key: str, upload_id: str) -> None:
        """Drop an upload and its parts."""
        try:
            with self._errors(key):
                self._client._abort_multipart_upload(self._bucket, check_key(key), upload_id)
        except UploadError:
            pass

    @contextmanager
    def _errors(self, key: str = "") -> Iterator[None]:
        """Say every failure in the project's own errors."""
        try:
            yield
        except S3Error as error:
            if error.code in ("NoSuchKey", "NoSuchObject"):
                raise ObjectMissing(key) from None
            if error.code == "NoSuchUpload":
                message = "there is no such upload: it was completed, aborted or has expired; begin a new one"
                raise UploadError(message) from None
            if error.code in _BAD_PARTS:
                raise UploadError(f"the parts do not make an object ({error.message}): upload them again") from None
            raise StoreUnavailable(f"the object store {self._where} refused: {error.code}, {error.message}") from error
        except (ServerError, InvalidResponseError, MinioException, urllib3.exceptions.HTTPError) as error:
            raise StoreUnavailable(f"the object store {self._where} does not answer: {error}") from error


def _client(location: S3Location, endpoint: str, secure: bool) -> Minio:
    # minio-py's own pool waits five minutes and tries five times: a dead server would hold a worker for long.
    retries = urllib3.Retry(total=3, backoff_factor=0.2, status_forcelist=[500, 502, 503, 504])
    timeout = urllib3.Timeout(connect=3, read=60)
    return Minio(
        endpoint,
        access_key=location.access_key,
        secret_key=location.secret_key.get_secret_value(),
        secure=secure,
        region=location.region,  # given, so that presigning needs no request
        http_client=urllib3.PoolManager(timeout=timeout, retries=retries, maxsize=8),
    )


def _info(key: str, size: int | None, etag: str | None, modified: datetime | None) -> ObjectInfo:
    return ObjectInfo(key, size or 0, (etag or "").strip('"'), modified or datetime.fromtimestamp(0, UTC))
