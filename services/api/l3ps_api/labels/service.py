"""From a finished job's manifest to presigned URLs."""

from __future__ import annotations

from itertools import islice

from l3ps_api.labels.manifests import Manifest, PublishedFile
from l3ps_api.labels.published import Published, published
from l3ps_api.labels.schemas import ALL_AT_ONCE, MOST_AT_ONCE, LabelFile, LabelFiles, Side
from l3ps_api.problems import ApiProblem, ErrorItem, invalid
from l3ps_api.services import Services


def files(
    services: Services,
    job_id: str,
    label_format: str | None,
    *,
    limit: int | None = None,
    cursor: str | None = None,
    side: Side | None = None,
    scene: str | None = None,
    scan: str | None = None,
) -> LabelFiles:
    """The files of one format that meet the filters, or a page of them. NotFound for the job.

    Each URL costs its signature, so 422 for all at once where they are many.
    """
    found = published(services, job_id, label_format)
    manifest = services.manifests.get(services.store, found.key)
    names = {name: wanted for name, wanted in (("scene", scene), ("scan", scan)) if wanted is not None}

    def wanted(file: PublishedFile) -> bool:
        return side in (None, file.side) and all(getattr(file, name) == value for name, value in names.items())

    left = manifest.of_format(found.label_format, int(cursor or 0))
    listed = list(islice((pair for pair in left if wanted(pair[1])), (limit or ALL_AT_ONCE) + 1))
    if not listed:
        _check_names(manifest, found, names)
    if limit is None and len(listed) > ALL_AT_ONCE:
        what = f"the job has more than {ALL_AT_ONCE} such files, too many to be listed at once"
        remedy = f"Ask by pages: send limit={MOST_AT_ONCE}, then the answer's `next` as cursor; or name a scene."
        raise invalid("query limit", what, remedy)
    following = str(listed.pop()[0]) if limit is not None and len(listed) > limit else None
    documents = [_document(services, file) for _, file in listed]
    return LabelFiles(job_id=job_id, format=found.label_format, files=documents, next=following)


def url(services: Services, job_id: str, path: str) -> str:
    """A presigned URL of one file, of whatever format. NotFound for the job, 404 for the file."""
    manifest = services.manifests.get(services.store, published(services, job_id, None).key)
    number = manifest.places.get(path)
    if number is None:
        what, remedy = f"the job has no file {path!r}", f"Use a path that GET /v1/jobs/{job_id}/labels names."
        error = ErrorItem(where="path", what=what, remedy=remedy)
        raise ApiProblem(404, "unknown-file", "Unknown file", f"path: {what}. {remedy}", [error])
    return _presigned(services, manifest.files[number])


def _check_names(manifest: Manifest, found: Published, names: dict[str, str]) -> None:
    """422 for a scene or scan that the job has no labels of."""
    files = [file for _, file in manifest.of_format(found.label_format)]
    for name, wanted in names.items():
        files = [file for file in files if getattr(file, name) == wanted]
        if not files:
            remedy = f"Use a {name} that GET /v1/jobs/{found.job_id}/labels names."
            raise invalid(f"query {name}", f"the job has no labels of a {name} {wanted!r}", remedy)


def _document(services: Services, file: PublishedFile) -> LabelFile:
    return LabelFile(
        path=file.path,
        size=file.size,
        sha256=file.sha256,
        side=file.side,
        scene=file.scene,
        scan=file.scan,
        url=_presigned(services, file),
    )


def _presigned(services: Services, file: PublishedFile) -> str:
    return services.store.presign_get(file.key, services.settings.url_ttl_seconds, file.path.rpartition("/")[2])
