"""A file to the service: announced, sent in parallel parts, each checked, gone on with where it was broken off.

    announce ─ POST /v1/uploads ──────────────► the URLs of the parts            noted: key, then id
    send ───── PUT each part to its URL ──────► its ETag, compared with its MD5  the whole's SHA-256 beside it
    complete ─ POST /v1/uploads/{id}/complete ► the drive, model or annotations  note removed

A process that finds a note asks the service what it has got and sends the rest. Where the service has joined the parts
and died before it could say so, the completion is all that is left to send.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock
from typing import Any, Literal

from l3ps_client._documents import Upload
from l3ps_client._errors import Damaged, Forbidden, L3psClientError, NotFound, Refused
from l3ps_client._ledger import Ledger, Note
from l3ps_client._wire import Wire, new_key

Kind = Literal["drive", "model", "annotations"]
Progress = Callable[[int, int], None]
"""Called with (bytes done, bytes in all), one call at a time, from any thread; a part sent again counts back."""

FOLDERS = {"drive": "drives", "model": "models", "annotations": "annotations"}
"""Where the service keeps what an upload of a kind becomes."""

_BLOCK = 1 << 18
"""Bytes read and sent in one go: httpcore copies what the socket leaves of a block, so larger ones are slower."""
_URLS_AT_ONCE = 200
_NOT_THE_UPLOAD = (401, 403, 408, 421, 429)
"""Refusals of the one who asks, or of the moment: with another key, or later, the same upload goes on."""
_GOES_ON = ("request-in-progress", "conflict", "invalid-parts")
"""Refusals that leave the upload as it is: another request has it in hand, or parts are to be sent again."""
_MD5 = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True)
class Options:
    """How a file is sent.

    Attributes:
        kind: ``drive``, ``model`` or ``annotations``.
        name: what it is to be called; None for the file's name without its suffix.
        sha256: hex digest of the file, where it is known; else it is computed while sending.
        abort_on_error: leave nothing to go on with when sending is interrupted.
        parallel: parts on their way at once.
        verify: compare each part's ETag with its MD5; False for stores that encrypt with keys of their own.
    """

    kind: Kind
    name: str | None = None
    sha256: str | None = None
    abort_on_error: bool = False
    parallel: int = 4
    verify: bool = True


def send(wire: Wire, ledger: Ledger, file: Path, options: Options, progress: Progress) -> Any:
    """Send a file; the document of what it became."""
    status = file.stat()
    identity: dict[str, Any] = {"url": wire.config.url, "project": wire.config.project, "kind": options.kind}
    # Equal bytes under another name go on too: a directory is packed anew, into another temporary file, each time.
    identity |= {"sha256": options.sha256} if options.sha256 else {"path": str(file.resolve())}
    identity |= {"size": status.st_size} | ({} if options.sha256 else {"mtime": status.st_mtime_ns})
    with ledger.note(**identity) as note:
        upload = _known(wire, note) or _announced(wire, note, file, status.st_size, options)
        if upload["state"] == "complete":
            note.forget()
            return wire.get(f"/v1/{FOLDERS[upload['kind']]}/{upload['result_id']}")
        try:
            transfer = _Transfer(wire, file, upload, options, progress)
            sha256 = transfer.run()
            if (file.stat().st_size, file.stat().st_mtime_ns) != (status.st_size, status.st_mtime_ns):
                raise Damaged(f"{file} changed while it was sent; nothing was kept. Send it again once it is written.")
            completion: dict[str, Any] = {"sha256": sha256} | ({"name": options.name} if options.name else {})
            completion |= {"parts": tags} if (tags := transfer.tags()) else {}
            result = wire.post(f"/v1/uploads/{upload['id']}/complete", completion)
        except BaseException as error:
            if options.abort_on_error or not note.lasting or _is_final(error):
                note.forget()
                with suppress(L3psClientError):
                    wire.delete(f"/v1/uploads/{upload['id']}")
            raise
        note.forget()
        return result


def _known(wire: Wire, note: Note) -> Upload | None:
    """The upload that a note tells of, if the service can go on with it."""
    if "upload_id" not in note.facts:
        return None
    with suppress(NotFound):
        upload: Upload = wire.get(f"/v1/uploads/{note.facts['upload_id']}")
        if upload["state"] == "complete" or (upload["state"] == "open" and "received" in upload):
            return upload
    note.forget()
    return None


def _announced(wire: Wire, note: Note, file: Path, size: int, options: Options) -> Upload:
    if "announced" not in note.facts:
        # The key is on the disk before the request is on its way: killed in between, the next process sends the same
        # request again and gets the same upload.
        body = {"kind": options.kind, "filename": file.name, "size": size}
        body |= {"sha256": options.sha256} if options.sha256 else {}
        note.save(path=str(file.resolve()), name=options.name, key=new_key(), announced=body)
    try:
        upload: Upload = wire.post("/v1/uploads", note.facts["announced"], key=note.facts["key"])
    except Refused as error:
        if error.code not in _GOES_ON:
            note.forget()
        raise
    note.save(upload_id=upload["id"])
    return upload


def _is_final(error: BaseException) -> bool:
    """Whether the same upload would fail again, so that there is nothing to go on with."""
    if isinstance(error, Refused):
        return error.status < 500 and error.status not in _NOT_THE_UPLOAD and error.code not in _GOES_ON
    return isinstance(error, Damaged)


class _StoppedError(Exception):
    """Another part failed, or the user had enough."""


class _Transfer:
    """The parts of one upload on their way."""

    def __init__(self, wire: Wire, file: Path, upload: Upload, options: Options, progress: Progress) -> None:
        self._wire, self._file, self._upload, self._options = wire, file, upload, options
        self._size, self._part_size = upload["size"], upload["part_size"]
        # Of an upload that was joined before its service died no part is wanted, only the completion.
        count = 0 if upload.get("joined") else max(1, -(-self._size // self._part_size))
        self._numbers = range(1, count + 1)
        self._urls = {part["number"]: part["url"] for part in upload.get("parts", [])}
        self._there = {part["number"]: part for part in upload.get("received", [])}
        self._etags: dict[int, str] = {}
        self._progress, self._done = progress, 0
        self._lock, self._renewing, self._stop = Lock(), Lock(), Event()

    def run(self) -> str:
        """Send what the service has not got; hex SHA-256 of the whole file."""
        with ThreadPoolExecutor(self._options.parallel) as pool, ThreadPoolExecutor(1) as beside:
            digest = beside.submit(self._or_stop, self._sha256)
            work: list[Future[Any]] = [pool.submit(self._or_stop, self._part, number) for number in self._numbers]
            try:
                wait([digest, *work])
            except BaseException:
                self._stop.set()
                pool.shutdown(wait=True, cancel_futures=True)
                raise
        failures = [error for future in [*work, digest] if (error := future.exception()) is not None]
        if failures:
            raise next((error for error in failures if not isinstance(error, _StoppedError)), failures[0])
        if not self._numbers:
            self._advance(self._size)
        sha256: str = digest.result()
        return sha256

    def tags(self) -> list[dict[str, Any]]:
        """Every part with its ETag, in order."""
        return [{"number": number, "etag": self._etags[number]} for number in self._numbers]

    def _or_stop(self, work: Callable[..., Any], *arguments: Any) -> Any:
        """Do a share of the work; where that fails, nobody need begin another one."""
        if self._stop.is_set():
            raise _StoppedError
        try:
            return work(*arguments)
        except BaseException:
            self._stop.set()
            raise

    def _part(self, number: int) -> None:
        start = (number - 1) * self._part_size
        length = min(self._part_size, self._size - start)
        there = self._there.get(number)
        if there is not None and there["size"] == length:
            digest = hashlib.md5(usedforsecurity=False)
            for block in self._blocks(start, length):
                digest.update(block)
            if _tag(there["etag"]) == digest.hexdigest():
                self._etags[number] = _tag(there["etag"])
                self._advance(length)
                return
        for _ in range(2):
            etag, md5 = self._put(number, start, length)
            if not self._options.verify or not _MD5.fullmatch(etag) or etag == md5:
                self._etags[number] = etag
                return
            self._advance(-length)
        raise Damaged(
            f"Part {number} of {self._file} arrived damaged twice (ETag {etag}, MD5 {md5}); nothing was kept. Try "
            "again, or with verify=False where the store encrypts with keys of its own."
        )

    def _put(self, number: int, start: int, length: int) -> tuple[str, str]:
        """Send one part; the ETag it got and its MD5."""
        sent = 0
        digest = hashlib.md5(usedforsecurity=False)

        def content() -> Iterator[bytes]:
            nonlocal sent, digest
            self._advance(-sent)  # a part that starts over
            sent, digest = 0, hashlib.md5(usedforsecurity=False)
            for block in self._blocks(start, length):
                digest.update(block)
                yield block
                sent += len(block)
                self._advance(len(block))

        url = self._url(number)
        try:
            answer = self._wire.put_object(url, content, length, self._stop.wait)
        except Forbidden as error:
            try:
                url = self._url(number, stale=url)
            except Refused:
                raise error from None
            answer = self._wire.put_object(url, content, length, self._stop.wait)
        return _tag(answer.headers.get("etag", "")), digest.hexdigest()

    def _url(self, number: int, stale: str | None = None) -> str:
        """Where a part goes; asked for where there was no URL, or one that has expired."""
        with self._renewing:
            if self._urls.get(number) == stale:
                missing = [later for later in self._numbers[number - 1 :] if later not in self._etags]
                wanted = missing[:_URLS_AT_ONCE]
                fresh = self._wire.post(f"/v1/uploads/{self._upload['id']}/parts", {"numbers": wanted})
                self._urls |= {part["number"]: part["url"] for part in fresh["parts"]}
            return self._urls[number]

    def _blocks(self, start: int, length: int) -> Iterator[bytes]:
        with self._file.open("rb", buffering=0) as source:
            source.seek(start)
            left = length
            while left:
                if self._stop.is_set():
                    raise _StoppedError
                block = source.read(min(_BLOCK, left))
                if not block:
                    raise Damaged(f"{self._file} became shorter while it was sent; nothing was kept. Send it again.")
                yield block
                left -= len(block)

    def _sha256(self) -> str:
        if self._options.sha256 is not None:
            return self._options.sha256
        digest = hashlib.sha256()
        for block in self._blocks(0, self._size):
            digest.update(block)
        return digest.hexdigest()

    def _advance(self, count: int) -> None:
        if count:
            with self._lock:
                self._done += count
                self._progress(self._done, self._size)


def _tag(etag: str) -> str:
    return etag.strip().strip('"')
