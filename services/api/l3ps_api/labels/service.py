"""From a finished job's manifest to presigned URLs."""

from __future__ import annotations

from typing import Any

from l3ps_api.labels.manifests import published, side_of
from l3ps_api.labels.schemas import LabelFile, LabelFiles, Side
from l3ps_api.problems import ApiProblem, ErrorItem, invalid
from l3ps_api.services import Services


def files(
    services: Services,
    job_id: str,
    label_format: str | None,
    *,
    side: Side | None = None,
    scene: str | None = None,
    scan: str | None = None,
) -> LabelFiles:
    """The files of one format that meet the filters. NotFound for the job."""
    found = published(services, job_id, label_format)
    listed = list(found.files(found.manifest(services.store)))
    for name, wanted in (("scene", scene), ("scan", scan)):
        if wanted is not None:
            listed = [file for file in listed if file.get(name) == wanted]
            if not listed:
                remedy = f"Use a {name} that GET /v1/jobs/{job_id}/labels names."
                raise invalid(f"query {name}", f"the job has no labels of a {name} {wanted!r}", remedy)
    if side is not None:
        listed = [file for file in listed if side_of(file) == side]
    documents = [_document(services, file) for file in listed]
    return LabelFiles(job_id=job_id, format=found.label_format, files=documents)


def url(services: Services, job_id: str, path: str) -> str:
    """A presigned URL of one file, of whatever format. NotFound for the job, 404 for the file."""
    manifest = published(services, job_id, None).manifest(services.store)
    file = next((file for file in manifest["files"] if file["path"] == path), None)
    if file is None:
        what, remedy = f"the job has no file {path!r}", f"Use a path that GET /v1/jobs/{job_id}/labels names."
        error = ErrorItem(where="path", what=what, remedy=remedy)
        raise ApiProblem(404, "unknown-file", "Unknown file", f"path: {what}. {remedy}", [error])
    return _presigned(services, file)


def _document(services: Services, file: dict[str, Any]) -> LabelFile:
    return LabelFile(
        path=file["path"],
        size=file["size"],
        sha256=file["sha256"],
        side=side_of(file),
        scene=file.get("scene"),
        scan=file.get("scan"),
        url=_presigned(services, file),
    )


def _presigned(services: Services, file: dict[str, Any]) -> str:
    return services.store.presign_get(
        file["key"], services.settings.url_ttl_seconds, file["path"].rpartition("/")[2]
    )  # fmt: skip
