"""Uploads and what they become: drives, models and annotations."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from l3ps_client._documents import Annotations, Drive, Model, Page, Upload
from l3ps_client._errors import NotFound
from l3ps_client._ledger import Ledger
from l3ps_client._resource import Group, items, path
from l3ps_client._sending import Kind, Options, Progress, send
from l3ps_client._wire import Wire


def _quietly(done: int, total: int) -> None:
    """Nobody wants to know."""


class Uploads(Group):
    """``client.uploads``: files on their way to the service."""

    def __init__(self, wire: Wire, ledger: Ledger) -> None:
        super().__init__(wire)
        self._ledger = ledger

    def send(
        self,
        file: str | Path,
        kind: Kind = "drive",
        *,
        name: str | None = None,
        sha256: str | None = None,
        progress: Progress = _quietly,
        abort_on_error: bool = False,
        parallel: int = 4,
        verify: bool = True,
    ) -> Any:
        """Send a file in parts, each checked, and complete the upload.

        Interrupted, killed or cut off, the same call later sends only what is missing, also from another process. A
        file that the service refuses leaves no upload behind.

        Args:
            file: an archive: ``.zip``, ``.tar``, ``.tar.gz`` or ``.tar.zst``.
            kind: ``drive``, ``model`` or ``annotations``.
            name: what it is to be called; default: the file's name without its suffix.
            sha256: hex digest of the file, where it is known; else it is computed while sending.
            progress: called with (bytes done, bytes in all).
            abort_on_error: give the upload up when it is interrupted, instead of leaving it for the next call.
            parallel: parts on their way at once.
            verify: compare each part's ETag with its MD5; False for stores that encrypt with keys of their own.

        Returns:
            The document of what was uploaded.

        Raises:
            Refused: the service does not take it.
            Unreachable: the connection did not come back in time; call again.
            Damaged: the file changed, or a part arrived damaged twice.
        """
        options = Options(kind, name, sha256, abort_on_error, parallel, verify)
        return send(self._wire, self._ledger, Path(file), options, progress)

    def unfinished(self, file: str | Path) -> list[dict[str, Any]]:
        """What this machine knows of interrupted uploads of a file: ``upload_id``, ``name``, ``announced``."""
        return self._ledger.of_file(Path(file))

    def get(self, upload_id: str) -> Upload:
        """An upload: its state, the parts that have arrived, and what it became."""
        upload: Upload = self._wire.get(path("uploads", upload_id))
        return upload

    def abort(self, upload_id: str) -> None:
        """Give an open upload up."""
        self._wire.delete(path("uploads", upload_id))

    def page(self, *, limit: int = 50, cursor: str | None = None, state: str | None = None) -> Page[Upload]:
        """One page of uploads, newest first."""
        page: Page[Upload] = self._wire.get(path("uploads"), limit=limit, cursor=cursor, state=state)
        return page

    def list(self, *, limit: int | None = None, state: str | None = None) -> Iterator[Upload]:
        """Uploads, newest first, over all pages or the first ``limit``."""
        return items(self._wire, path("uploads"), limit, state=state)


class Drives(Group):
    """``client.drives``: drive logs."""

    def __init__(self, wire: Wire, uploads: Uploads) -> None:
        super().__init__(wire)
        self._uploads = uploads

    def upload(self, file: str | Path, *, progress: Progress = _quietly, **options: Any) -> Drive:
        """Send a drive log's archive; options as of ``uploads.send``."""
        drive: Drive = self._uploads.send(file, "drive", progress=progress, **options)
        return drive

    def get(self, drive_id: str) -> Drive:
        """A drive: its state, what the check found in it and, if it was rejected, why."""
        drive: Drive = self._wire.get(path("drives", drive_id))
        return drive

    def find(self, sha256: str) -> Drive | None:
        """A drive made of these bytes that was not rejected, so that they need not be sent again."""
        found: Iterator[Drive] = items(self._wire, path("drives"), None, sha256=sha256)
        return next((drive for drive in found if drive["state"] != "rejected"), None)

    def page(self, *, limit: int = 50, cursor: str | None = None, **filters: Any) -> Page[Drive]:
        """One page of drives, newest first."""
        page: Page[Drive] = self._wire.get(path("drives"), limit=limit, cursor=cursor, **filters)
        return page

    def list(self, *, limit: int | None = None) -> Iterator[Drive]:
        """Drives, newest first, over all pages or the first ``limit``."""
        return items(self._wire, path("drives"), limit)

    def delete(self, drive_id: str) -> None:
        """Delete a drive's archive. Refused while a job uses it; finished jobs keep their labels."""
        self._wire.delete(path("drives", drive_id))


class AnnotationSets(Group):
    """``client.annotations``: archives of annotated images."""

    def __init__(self, wire: Wire, uploads: Uploads) -> None:
        super().__init__(wire)
        self._uploads = uploads

    def upload(self, file: str | Path, *, progress: Progress = _quietly, **options: Any) -> Annotations:
        """Send an archive of annotated images; options as of ``uploads.send``."""
        annotations: Annotations = self._uploads.send(file, "annotations", progress=progress, **options)
        return annotations

    def get(self, annotations_id: str) -> Annotations:
        """An archive of annotated images."""
        annotations: Annotations = self._wire.get(path("annotations", annotations_id))
        return annotations

    def find(self, sha256: str) -> Annotations | None:
        """Annotations made of these bytes, so that they need not be sent again."""
        found: Iterator[Annotations] = items(self._wire, path("annotations"), 1, sha256=sha256)
        return next(found, None)

    def list(self, *, limit: int | None = None) -> Iterator[Annotations]:
        """Annotations, newest first, over all pages or the first ``limit``."""
        return items(self._wire, path("annotations"), limit)

    def delete(self, annotations_id: str) -> None:
        """Delete an archive. Refused while a training uses it; models that were trained on it stay."""
        self._wire.delete(path("annotations", annotations_id))


class Models(Group):
    """``client.models``: model bundles."""

    def __init__(self, wire: Wire, uploads: Uploads) -> None:
        super().__init__(wire)
        self._uploads = uploads

    def upload(self, file: str | Path, *, name: str, progress: Progress = _quietly, **options: Any) -> Model:
        """Send a bundle's zip; options as of ``uploads.send``."""
        model: Model = self._uploads.send(file, "model", name=name, progress=progress, **options)
        return model

    def get(self, model: str) -> Model:
        """A model by its name or id."""
        document: Model = self._wire.get(path("models", model))
        return document

    def find(self, name: str) -> Model | None:
        """A model by its name or id, None where there is none."""
        try:
            return self.get(name)
        except NotFound:
            return None

    def page(self, *, limit: int = 50, cursor: str | None = None) -> Page[Model]:
        """One page of models, newest first."""
        page: Page[Model] = self._wire.get(path("models"), limit=limit, cursor=cursor)
        return page

    def list(self, *, limit: int | None = None) -> Iterator[Model]:
        """Models, newest first, over all pages or the first ``limit``."""
        return items(self._wire, path("models"), limit)

    def delete(self, model: str) -> None:
        """Delete a model by its name or id. Refused while a job uses it; finished jobs keep their labels."""
        self._wire.delete(path("models", model))
