"""The port to the object store: what the product needs of S3 and no more."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import BinaryIO, Protocol


@dataclass(frozen=True, slots=True)
class ObjectInfo:
    """One object as the store sees it; ``etag`` without quotes."""

    key: str
    size: int
    etag: str
    modified: datetime


@dataclass(frozen=True, slots=True)
class Part:
    """One part of a multipart upload: as the client reports it (quotes around the etag do not matter), or as stored.

    ``etag`` is the md5 of the part's bytes in hex. ``size`` is known of stored parts only, bytes.
    """

    number: int
    etag: str
    size: int | None = None


@dataclass(frozen=True, slots=True)
class Pending:
    """A multipart upload that was begun and neither completed nor aborted."""

    key: str
    upload_id: str
    begun: datetime


GONE = "there is no such upload: it was completed, aborted or has expired; begin a new one"
"""What an UploadError says of an upload that the store does not know."""


class ObjectStore(Protocol):
    """Named bytes. Writes are atomic: a reader sees the old object, the new one or none.

    Every method may raise StoreUnavailable; every key is checked (InvalidKey). The content type follows from the
    key's suffix.
    """

    def ensure(self) -> None:
        """Create the bucket or directory if it is missing."""

    def ping(self) -> None:
        """Raise StoreUnavailable unless the store answers."""

    def put_file(self, key: str, path: Path) -> None:
        """Store a file."""

    def put_bytes(self, key: str, data: bytes) -> None:
        """Store bytes."""

    def get_file(self, key: str, path: Path) -> None:
        """Fetch an object into a file; ``path`` appears complete or not at all. ObjectMissing."""

    def get_bytes(self, key: str, offset: int = 0, length: int | None = None) -> bytes:
        """The object's bytes from ``offset`` on, at most ``length`` of them. ObjectMissing."""

    def open(self, key: str, offset: int = 0) -> AbstractContextManager[BinaryIO]:
        """A stream for reading once, from ``offset`` to the end. ObjectMissing.

        A stream that ends is complete: one that broke off raises StoreUnavailable at the read that finds out.
        """

    def stat(self, key: str) -> ObjectInfo:
        """Size, etag and age. ObjectMissing."""

    def exists(self, key: str) -> bool:
        """Whether there is such an object."""

    def list(self, prefix: str = "") -> Iterator[ObjectInfo]:
        """All objects below ``prefix`` (empty, or ending with a slash), in the order of their keys."""

    def delete(self, key: str) -> None:
        """Delete an object; nothing happens if there is none."""

    def delete_prefix(self, prefix: str) -> int:
        """Delete all objects below ``prefix``; returns how many."""

    def presign_get(self, key: str, seconds: int, filename: str | None = None) -> str:
        """A URL that downloads the object without credentials; ``filename`` is what the browser saves it as."""

    def presign_put(self, key: str, seconds: int) -> str:
        """A URL that stores the body of one PUT."""

    def create_multipart(self, key: str, part_size: int) -> str:
        """Begin a multipart upload of parts of ``part_size`` bytes, the last perhaps of fewer; returns its id."""

    def presign_part(self, key: str, upload_id: str, number: int, seconds: int, size: int | None = None) -> str:
        """A URL that stores the body of one PUT as part ``number`` (from 1); the reply's ETag names it.

        With ``size`` the URL takes a body of exactly so many bytes and refuses every other.
        """

    def list_parts(self, key: str, upload_id: str) -> Sequence[Part]:
        """The parts that have arrived, by number, with their sizes. UploadError when there is no such upload."""

    def list_multipart(self) -> Iterator[Pending]:
        """Multipart uploads in progress; of very many perhaps not all, but then others the next time."""

    def complete_multipart(self, key: str, upload_id: str, parts: Sequence[Part]) -> ObjectInfo:
        """Join the parts in the order of their numbers into one object. UploadError when they do not fit."""

    def abort_multipart(self, key: str, upload_id: str) -> None:
        """Drop an upload and its parts; nothing happens if there is none."""

    def tidy(self, before: datetime) -> int:
        """Delete what processes that died before then left half written, where the store keeps such; how much."""
