"""Bytes from the service or its object store into a file: resumed by range, checked, there only when whole."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from threading import Lock
from typing import Any

import httpx

from l3ps_client._bulk import BULK
from l3ps_client._digest import Digest
from l3ps_client._errors import Damaged, Refused, TooManyRequests, Unreachable
from l3ps_client._sending import Progress
from l3ps_client._wire import Wire

_RESUME_FROM = 1 << 20
"""Bytes from which on it pays to note how far a file has come; smaller ones start over."""
_BLOCK = 1 << 20


class Count:
    """Bytes there of one file or several, told one call at a time.

    Attributes:
        total: bytes in all; 0 while nobody knows.
        stopped: further bytes are not wanted: another file failed, or the user had enough.
    """

    def __init__(self, progress: Progress, total: int = 0) -> None:
        self.total, self.stopped = total, False
        self._progress, self._done, self._lock = progress, 0, Lock()

    def add(self, count: int) -> None:
        """So many more are there."""
        if self.stopped:
            raise _StoppedError
        if count:
            with self._lock:
                self._done += count
                self._progress(self._done, self.total)


class _StoppedError(Exception):
    """Further bytes are not wanted."""


@dataclass(frozen=True)
class Source:
    """What to receive.

    Attributes:
        url: where from.
        presigned: whether the URL carries its own credentials.
        params: of the query.
        size: bytes announced, None where only the answer tells.
        sha256: hex digest announced, None where there is none.
    """

    url: str
    presigned: bool = True
    params: Mapping[str, Any] = field(default_factory=dict)
    size: int | None = None
    sha256: str | None = None


def receive(wire: Wire, source: Source, target: Path, count: Count) -> None:
    """Bring a file; ``count`` is told of bytes newly there, negative where they turned out useless.

    Raises Damaged when twice in a row the bytes were not those announced; nothing of them is kept then.
    """
    partial = _Partial(target, source)
    for fresh in (False, True):
        if fresh:
            count.add(-partial.length)
            partial.drop()
        try:
            _complete(wire, source, partial, count)
            partial.finish(target)
            return
        except Damaged:
            if fresh:
                count.add(-partial.length)
                partial.drop()
                raise
        except BaseException:
            if not partial.noted:
                partial.drop()
            raise


def inside(path: str) -> PurePosixPath:
    """A path of the service's listing; Damaged when it would leave the folder the files go to."""
    relative = PurePosixPath(path)
    # Windows reads a backslash as a separator, and takes C:name for a file in the present folder of drive C.
    strange = any(character in path for character in "\0\\:")
    if relative.is_absolute() or ".." in relative.parts or not relative.parts or strange:
        raise Damaged(f"The service names a file outside the target directory: {path!r}. Nothing written.")
    return relative


def _complete(wire: Wire, source: Source, partial: _Partial, count: Count) -> None:
    """Go on until all is there; a connection that brought something does not count as a failed try."""
    count.add(partial.length)
    attempt = 1
    while True:
        before = partial.length
        try:
            _once(wire, source, partial, count)
            return
        except (Unreachable, TooManyRequests) as error:
            attempt = 1 if partial.length > before else attempt + 1
            asked = error.retry_after or 0.0
            if attempt > wire.retry.tries + 2 or asked > wire.retry.longest_wait:
                raise
            time.sleep(max(asked, wire.retry.pause(attempt)))


def _once(wire: Wire, source: Source, partial: _Partial, count: Count) -> None:
    if source.size is not None and partial.length == source.size:
        return
    if not partial.etag:  # nothing tells whether other bytes would go with these
        count.add(-partial.length)
        partial.drop()
    asked = partial.length
    bulk = source.size is None or source.size - asked >= BULK
    headers = {"Range": f"bytes={asked}-", "If-Range": partial.etag} if asked else {}
    with (
        _starting_over_past_the_end(partial, count),
        wire.open(source.url, presigned=source.presigned, params=source.params, headers=headers, bulk=bulk) as answer,
    ):
        if asked and not _goes_on(answer, partial):
            count.add(-partial.length)
            partial.drop()
            if answer.status_code == 206:  # a range of other bytes: the store knows no If-Range
                raise Unreachable(f"{source.url.partition('?')[0]} changed meanwhile")
        whole = _whole_length(answer)
        if source.size is None and whole is not None:
            count.total = whole
        partial.begin(answer.headers.get("etag", ""))
        with partial.appending() as write:
            for block in answer.iter_raw():
                write(block)
                count.add(len(block))
    whole = source.size if whole is None else whole
    if whole is not None and partial.length != whole:
        raise Unreachable(f"{source.url.partition('?')[0]}: {partial.length} of {whole} bytes arrived")


@contextmanager
def _starting_over_past_the_end(partial: _Partial, count: Count) -> Iterator[None]:
    try:
        yield
    except Refused as error:
        if error.status != 416:
            raise
        count.add(-partial.length)
        partial.drop()
        raise Unreachable("there is less of it now than before") from error


def _goes_on(answer: httpx.Response, partial: _Partial) -> bool:
    """Whether an answer continues what is there. S3 servers ignore If-Range, so the ETag is looked at as well."""
    start = re.match(r"bytes (\d+)-", answer.headers.get("content-range", ""))
    same = answer.headers.get("etag", partial.etag) == partial.etag
    return answer.status_code == 206 and start is not None and int(start[1]) == partial.length and same


def _whole_length(answer: httpx.Response) -> int | None:
    told = answer.headers.get("content-range", "").rpartition("/")[2] or answer.headers.get("content-length", "")
    return int(told) if told.isdigit() else None


class _Partial:
    """The bytes of a file that are there so far, beside where it is to be: ``NAME.part``, its ETag ``NAME.part.etag``.

    Attributes:
        length: how many there are.
        etag: what the server called them, empty where it gave no name.
        noted: whether the next process can go on with them.
    """

    def __init__(self, target: Path, source: Source) -> None:
        self.path = target.with_name(target.name + ".part")
        self._etag_path = target.with_name(target.name + ".part.etag")
        self._source = source
        self.length, self.etag, self.noted = 0, "", False
        self._digest = Digest()
        with suppress(OSError, ValueError, KeyError):
            noted = json.loads(self._etag_path.read_text())
            if noted["sha256"] == source.sha256 and noted["etag"]:
                self._take_up(str(noted["etag"]))

    def _take_up(self, etag: str) -> None:
        with self.path.open("rb") as file:
            while block := file.read(_BLOCK):
                self._digest.update(block)
                self.length += len(block)
        self.etag, self.noted = etag, True
        if self._source.size is not None and self.length > self._source.size:
            self.drop()

    def begin(self, etag: str) -> None:
        """The server names the bytes that come now."""
        self.etag = "" if etag.startswith("W/") else etag

    @contextmanager
    def appending(self) -> Iterator[Callable[[bytes], None]]:
        """Gives a function that adds bytes."""
        with self.path.open("ab" if self.length else "wb", buffering=0) as file:

            def write(block: bytes) -> None:
                view = memoryview(block)
                while view:
                    view = view[file.write(view) :]
                if self._source.sha256 is not None:
                    self._digest.update_beside(block)
                self.length += len(block)
                if self._source.size is not None and self.length > self._source.size:
                    raise Damaged(f"{self.path.stem} is larger than announced and was removed. Try again.")
                if not self.noted and self.length >= _RESUME_FROM and self.etag:
                    self.noted = True
                    self._etag_path.write_text(json.dumps({"etag": self.etag, "sha256": self._source.sha256}))

            yield write

    def drop(self) -> None:
        """Nothing of it is of use."""
        self.path.unlink(missing_ok=True)
        self._etag_path.unlink(missing_ok=True)
        self.length, self.etag, self.noted = 0, "", False
        self._digest = Digest()

    def finish(self, target: Path) -> None:
        """Put the whole file where it belongs; Damaged when it is not what was announced."""
        if not self.path.exists():
            self.path.touch()  # an empty file never had a block
        expected, found = self._source.sha256, self._digest.hexdigest()
        if expected is not None and found != expected:
            what = f"{target.name} arrived damaged (sha256 {found}, announced {expected}) and was removed. Try again."
            raise Damaged(what)
        self.path.replace(target)
        self._etag_path.unlink(missing_ok=True)
