"""What happens at an upload, and what must not remain of a bad one."""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any

from l3ps_api.annotation_sets.schemas import Annotations
from l3ps_api.drives.schemas import Drive
from l3ps_api.models.schemas import MODEL_NAME, Model
from l3ps_api.pages import cut
from l3ps_api.problems import ApiProblem, conflict, invalid, too_large
from l3ps_api.services import Services
from l3ps_api.uploads import quota
from l3ps_api.uploads.arrival import join
from l3ps_api.uploads.parts import part_count, part_length, part_size, size_of_parts
from l3ps_api.uploads.schemas import (
    Completion,
    OpenUpload,
    PartUrl,
    PartUrls,
    ReceivedPart,
    Upload,
    UploadPage,
    UploadProgress,
    UploadRequest,
)
from l3ps_api.uploads.sniff import HEAD_BYTES, archive_kind, describe
from l3ps_platform.catalog import (
    ModelState,
    Transaction,
    UploadRow,
    UploadState,
    annotation_sets,
    bundles,
    drives,
    uploads,
)
from l3ps_platform.errors import Conflict, UploadError
from l3ps_platform.ids import new_id
from l3ps_platform.objects import MAX_SECONDS
from l3ps_platform.workflow import accept_drive, accept_model

_REMEDIES = {
    "drive": "Upload a drive log as .zip, .tar, .tar.gz or .tar.zst.",
    "model": "Upload a model bundle as .zip that holds model.onnx and model.json.",
    "annotations": "Upload annotated images as .zip, .tar, .tar.gz or .tar.zst.",
}
_LIMITS = {
    "drive": ("max_upload_bytes", "Split the log into shorter drives"),
    "model": ("max_model_bytes", "Export a smaller network"),
    "annotations": ("max_annotations_bytes", "Choose fewer images"),
}
"""The setting that limits a kind of file, and what else can be done about one that is too large."""
_SUFFIXES = (".zip", ".tar", ".tar.gz", ".tgz", ".tar.zst", ".tzst")


def open_upload(services: Services, request: UploadRequest) -> OpenUpload:
    """Begin a multipart upload and presign its parts; refuses files that are empty or too large."""
    settings = services.settings
    setting, smaller = _LIMITS[request.kind]
    limit = int(getattr(settings, setting))
    if request.size == 0:
        raise invalid("size", "the file is empty (0 bytes)", _REMEDIES[request.kind], code="empty-upload")
    if request.size > limit:
        what = f"{request.size} bytes are more than the {limit} bytes that kind {request.kind} may have"
        raise too_large("size", what, f"{smaller}, or raise L3PS_{setting.upper()}.")
    upload_id, count = new_id("upl"), part_count(request.size, settings)
    key = f"uploads/{upload_id}/archive"  # nothing of the client's: what it calls the file is the row's
    seconds = min(settings.upload_ttl_seconds, MAX_SECONDS)
    each = part_size(request.size, settings)
    with services.catalog.reading() as session:  # before anything is begun in the store
        quota.check(session, settings, request.size)
    multipart = services.store.create_multipart(key, each)
    try:
        with services.catalog.transaction() as tx:
            quota.check(tx.session, settings, request.size)
            row = uploads.add(
                tx,
                id=upload_id,
                kind=request.kind,
                filename=request.filename,
                size=request.size,
                sha256=request.sha256,
                parts=count,
                part_size=each,
                object_key=key,
                s3_upload_id=multipart,
                seconds=seconds,
            )
    except BaseException:
        services.store.abort_multipart(key, multipart)
        raise
    urls = _presigned(services, row, range(1, count + 1))
    return OpenUpload(**_fields(row), part_size=row.part_size, parts=urls)


def opened(services: Services, upload_id: str) -> OpenUpload:
    """An upload as its opening answered, with fresh URLs. NotFound."""
    with services.catalog.reading() as session:
        row = uploads.get(session, upload_id)
    urls = _presigned(services, row, range(1, row.parts + 1))
    return OpenUpload(**_fields(row), part_size=size_of_parts(row, services.settings), parts=urls)


def page(services: Services, limit: int, cursor: str | None, state: UploadState | None) -> UploadPage:
    """One page, newest first."""
    with services.catalog.reading() as session:
        rows = uploads.page(session, limit=limit + 1, before=cursor, state=state)
    shown, following = cut(rows, limit)
    items = [Upload(**_fields(row)) for row in shown]
    return UploadPage(items=items, next=following)


def get(services: Services, upload_id: str) -> UploadProgress:
    """An upload's state and what of it has arrived. NotFound."""
    with services.catalog.reading() as session:
        row = uploads.get(session, upload_id)
    received: list[ReceivedPart] = []
    joined = False
    if row.state is UploadState.OPEN:
        try:
            received = [
                ReceivedPart(number=part.number, size=part.size, etag=part.etag)
                for part in services.store.list_parts(row.object_key, row.s3_upload_id)
                if part.size is not None and part.size == part_length(part.number, row, services.settings)
            ]
        except UploadError:  # a completion joined the parts and was cut off, or the upload was closed in this moment
            joined = services.store.exists(row.object_key)
    each = size_of_parts(row, services.settings)
    return UploadProgress(**_fields(row), part_size=each, part_count=row.parts, received=received, joined=joined)


def urls(services: Services, upload_id: str, numbers: Iterable[int]) -> PartUrls:
    """Fresh URLs for parts of an open upload. NotFound; refuses closed uploads and parts it does not have."""
    with services.catalog.reading() as session:
        row = _must_be_open(uploads.get(session, upload_id))
    wanted = sorted(set(numbers))
    if wanted[-1] > row.parts:
        what = f"the upload has the parts 1 to {row.parts}, {wanted[-1]} is none of them"
        raise invalid("numbers", what, "Ask for parts that `received` of the upload lacks.", code="invalid-parts")
    return PartUrls(part_size=size_of_parts(row, services.settings), parts=_presigned(services, row, wanted))


def abort(services: Services, upload_id: str) -> None:
    """Give an open upload up."""
    with services.catalog.transaction() as tx:
        row = uploads.close(tx, upload_id, UploadState.ABORTED)
    services.store.abort_multipart(row.object_key, row.s3_upload_id)


def complete(services: Services, upload_id: str, completion: Completion) -> Drive | Model | Annotations:
    """Join the parts, look at the first bytes, and hand a drive or model to the ingest stage.

    May be repeated: a client that lost the answer gets the same drive, model or annotations again.
    """
    with services.catalog.reading() as session:
        row = uploads.get(session, upload_id)
    if row.state is UploadState.COMPLETE:
        return _result(services, row)
    name = _name(_must_be_open(row), completion)
    # No row is held while the store joins the parts: that can take seconds, and SQLite has one lock for all writers.
    refusal = join(services, row, completion) or _look(services, row)
    if refusal is not None:
        _discard(services, row)
        raise refusal
    try:
        with services.catalog.transaction() as tx:
            result_id, kept = _accept(tx, row, name, completion.sha256 or row.sha256)
            uploads.close(tx, upload_id, UploadState.COMPLETE, result_id)
    except Conflict as error:
        return _lost_race_or_name(services, row, error)
    if not kept:
        services.store.delete(row.object_key)
    with services.catalog.reading() as session:
        return _result(services, uploads.get(session, upload_id))


def _look(services: Services, row: UploadRow) -> ApiProblem | None:
    """What is plainly wrong with a joined file, found in its size and its first bytes."""
    size = services.store.stat(row.object_key).size
    if size != row.size:
        what = f"{size} bytes arrived, {row.size} were announced"
        return invalid("size", what, "Upload the file again; nothing was kept.", code="wrong-size")
    head = services.store.get_bytes(row.object_key, 0, HEAD_BYTES)
    kind = archive_kind(head)
    if kind is None or (row.kind == "model" and kind != "zip"):
        return invalid(row.filename, describe(head, row.kind), _REMEDIES[row.kind], code="not-an-archive")
    return None


def _discard(services: Services, row: UploadRow) -> None:
    with services.catalog.transaction() as tx:
        uploads.close(tx, row.id, UploadState.ABORTED)
    services.store.abort_multipart(row.object_key, row.s3_upload_id)
    services.store.delete(row.object_key)


def _must_be_open(row: UploadRow) -> UploadRow:
    if row.state is not UploadState.OPEN:
        detail = f"Upload {row.id} is {row.state}. Begin a new one with POST /v1/uploads."
        raise conflict("upload-closed", "The upload is closed", detail, where="path", remedy="Begin a new upload.")
    return row


def _presigned(services: Services, row: UploadRow, numbers: Iterable[int]) -> list[PartUrl]:
    """URLs that outlive the upload's remaining time by nothing, each for a body of the part's size alone."""
    seconds = int((row.expires_at - datetime.now(UTC)).total_seconds())
    seconds = max(1, min(seconds, services.settings.upload_ttl_seconds, MAX_SECONDS))
    store, settings = services.store, services.settings
    sized = [(number, part_length(number, row, settings)) for number in numbers]
    return [
        PartUrl(number=number, url=store.presign_part(row.object_key, row.s3_upload_id, number, seconds, length))
        for number, length in sized
    ]


def _name(row: UploadRow, completion: Completion) -> str:
    name = completion.name or _stem(row.filename)
    if row.kind == "model" and not re.fullmatch(MODEL_NAME, name):
        what = f"{name!r} cannot name a model"
        raise invalid("name", what, "Use up to 100 letters, digits, dots, dashes and underscores.", code="bad-name")
    return name


def _accept(tx: Transaction, row: UploadRow, name: str, sha256: str | None) -> tuple[str, bool]:
    """Make the drive, model or annotations; returns its id and whether it keeps the uploaded object."""
    file: dict[str, Any] = {
        "filename": row.filename, "size": row.size, "object_key": row.object_key, "sha256": sha256
    }  # fmt: skip
    if row.kind == "drive":
        return accept_drive(tx, name=name, **file).id, True
    if row.kind == "annotations":
        return annotation_sets.add(tx, name=name, **file).id, True
    known = bundles.named(tx.session, name)
    if known is not None and sha256 is not None and known.sha256 == sha256 and known.state is not ModelState.REJECTED:
        # On the client's word: it gets the model that has the checksum it names, which a worker checks or has checked.
        return known.id, False
    return accept_model(tx, name=name, **file).id, True


def _lost_race_or_name(services: Services, row: UploadRow, error: Conflict) -> Drive | Model | Annotations:
    """After a conflict: another request completed this upload meanwhile, or the model's name is taken."""
    with services.catalog.reading() as session:
        now = uploads.get(session, row.id)
    if now.state is UploadState.COMPLETE:
        return _result(services, now)
    if now.state is UploadState.ABORTED:  # given up while its parts were joined
        services.store.delete(row.object_key)
        _must_be_open(now)
    _discard(services, row)
    detail = f"{str(error)[:1].upper()}{str(error)[1:]}. Nothing was kept."
    raise conflict("name-taken", "The name is taken", detail, where="name", remedy="Choose another name.") from error


def _result(services: Services, row: UploadRow) -> Drive | Model | Annotations:
    with services.catalog.reading() as session:
        if row.kind == "drive":
            return Drive.of(drives.get(session, row.result_id or ""))
        if row.kind == "annotations":
            return Annotations.of(annotation_sets.get(session, row.result_id or ""))
        return Model.of(bundles.get(session, row.result_id or ""))


def _fields(row: UploadRow) -> dict[str, Any]:
    names = ("id", "kind", "filename", "size", "state", "result_id", "created_at", "expires_at")
    return {name: getattr(row, name) for name in names}


def _stem(filename: str) -> str:
    for suffix in sorted(_SUFFIXES, key=len, reverse=True):
        if filename.lower().endswith(suffix) and len(filename) > len(suffix):
            return filename[: -len(suffix)]
    return filename
