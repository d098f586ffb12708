"""The labels of finished jobs: single files, all files of a job, or several jobs as one archive."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from threading import Lock
from typing import Any

from l3ps_client._documents import LabelFile, LabelFiles
from l3ps_client._errors import Forbidden
from l3ps_client._receiving import Count, Source, inside, receive
from l3ps_client._resource import Group, path
from l3ps_client._sending import Progress

_BLOCK = 1 << 20
_PAGE = 1000
"""Files listed at a time."""


def _quietly(done: int, total: int) -> None:
    """Nobody wants to know."""


class Labels(Group):
    """``client.labels``: what jobs have made."""

    def list(
        self,
        job_id: str,
        *,
        format: str | None = None,
        scene: str | None = None,
        scan: str | None = None,
        side: str | None = None,
    ) -> LabelFiles:
        """A finished job's files with their checksums and presigned URLs.

        Args:
            job_id: the job.
            format: ``nuscenes`` or ``semantickitti``; default: the first that the job was asked for.
            scene: only files of this scene.
            scan: only files of this scan.
            side: only ``primal`` or only ``refined`` labels.
        """
        where = path("jobs", job_id, "labels")
        filters = {"format": format, "scene": scene, "scan": scan, "side": side}
        listing: LabelFiles = self._wire.get(where, **filters, limit=_PAGE)
        cursor = listing.pop("next", None)
        while cursor is not None:
            page: LabelFiles = self._wire.get(where, **filters, limit=_PAGE, cursor=cursor)
            listing["files"] += page["files"]
            cursor = page.get("next")
        return listing

    def download(
        self,
        job_id: str,
        folder: str | Path,
        *,
        format: str | None = None,
        scenes: Sequence[str] = (),
        scans: Sequence[str] = (),
        side: str | None = None,
        progress: Progress = _quietly,
        parallel: int = 4,
    ) -> Sequence[Path]:
        """Bring a job's label files below a folder, each checked against its SHA-256; returns their paths.

        Files already there and whole are not fetched again, broken-off ones are gone on with. No file appears under
        its name before it is whole.

        Args:
            job_id: a job that succeeded.
            folder: where the files go; made where absent.
            format: as of ``list``.
            scenes: only files of these scenes; all where empty.
            scans: only files of these scans; all where empty.
            side: only ``primal`` or only ``refined`` labels.
            progress: called with (bytes there, bytes in all).
            parallel: files on their way at once.

        Raises:
            Damaged: a file is twice not what the service announced, or would lie outside the folder.
        """
        listing = _Listing(self, job_id, {"format": format, "side": side}, scenes, scans)
        targets = {file["path"]: Path(folder) / inside(file["path"]) for file in listing.files}
        count = Count(progress, sum(file["size"] for file in listing.files))
        with ThreadPoolExecutor(parallel) as pool:
            try:
                waiting = [
                    pool.submit(self._fetch, listing, file, targets[file["path"]], count) for file in listing.files
                ]
                for future in as_completed(waiting):
                    future.result()
            except BaseException:
                count.stopped = True
                pool.shutdown(wait=True, cancel_futures=True)
                raise
        return [*targets.values()]

    def read(self, job_id: str, file: str) -> bytes:
        """One label file by its path in the listing, without the rest."""
        with self._wire.open(path("jobs", job_id, "labels", *inside(file).parts), presigned=False) as answer:
            where = answer.headers.get("location")
            if where is None:
                return answer.read()
        with self._wire.open(where, presigned=True) as answer:
            return answer.read()

    def archive(
        self, jobs: str | Sequence[str], file: str | Path, *, format: str | None = None, progress: Progress = _quietly
    ) -> Path:
        """Bring the labels of one job, or of several, as one tar; gone on with where it was broken off.

        Args:
            jobs: id of a job that succeeded, or several.
            file: the archive to write; it appears when it is whole.
            format: as of ``list``.
            progress: called with (bytes there, bytes in all).
        """
        one = jobs if isinstance(jobs, str) else None
        where = path("jobs", one, "labels.tar") if one else path("labels.tar")
        params: dict[str, Any] = {"format": format} | ({} if one else {"job": [*jobs]})
        target = Path(file)
        target.parent.mkdir(parents=True, exist_ok=True)
        receive(self._wire, Source(where, False, params), target, Count(progress))
        return target

    def _fetch(self, listing: _Listing, file: LabelFile, target: Path, count: Count) -> None:
        if target.is_file() and target.stat().st_size == file["size"] and _sha256(target) == file["sha256"]:
            count.add(file["size"])
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        url = file["url"]
        for fresh in (False, True):
            try:
                receive(self._wire, Source(url, True, {}, file["size"], file["sha256"]), target, count)
                return
            except Forbidden:
                if fresh:
                    raise
                url = listing.fresh_url(file["path"], url)


class _Listing:
    """The files to fetch; their URLs are asked for again when they have expired, which large downloads outlive."""

    def __init__(
        self, labels: Labels, job_id: str, filters: dict[str, Any], scenes: Sequence[str], scans: Sequence[str]
    ) -> None:
        self._labels, self._job_id, self._filters = labels, job_id, filters
        self._which: list[dict[str, str]] = [
            ({"scene": scene} if scene else {}) | ({"scan": scan} if scan else {})
            for scene in scenes or [""]
            for scan in scans or [""]
        ]
        self._lock = Lock()
        self._files = self._ask()

    @property
    def files(self) -> Sequence[LabelFile]:
        return [*self._files.values()]

    def fresh_url(self, path: str, stale: str) -> str:
        """A file's URL that is not the one that has expired."""
        with self._lock:
            if self._files[path]["url"] == stale:
                self._files |= self._ask()
            return self._files[path]["url"]

    def _ask(self) -> dict[str, LabelFile]:
        listed = [self._labels.list(self._job_id, **self._filters, **which)["files"] for which in self._which]
        return {file["path"]: file for files in listed for file in files}


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()
