"""Whether all parts of an upload are there, and as announced, before they are joined."""

from __future__ import annotations

from collections.abc import Sequence

from l3ps_api.problems import ApiProblem, invalid
from l3ps_api.services import Services
from l3ps_api.uploads.parts import part_length
from l3ps_api.uploads.schemas import Completion
from l3ps_platform.catalog import UploadRow
from l3ps_platform.errors import UploadError
from l3ps_platform.objects import Part

_NAMED = 10
"""Parts that a message names at most."""


def join(services: Services, row: UploadRow, completion: Completion) -> ApiProblem | None:
    """Join the parts that have arrived.

    Returns:
        Why they never will make the announced file, in which case nothing was joined and the upload is to be dropped.

    Raises:
        ApiProblem: parts are missing or others than the client named; the upload can go on.
    """
    if completion.parts is not None:
        numbers = [part.number for part in completion.parts]
        if sorted(numbers) != list(range(1, row.parts + 1)):
            what = f"the upload has the parts 1 to {row.parts}, each once; {len(numbers)} were named"
            raise invalid("parts", what, "Name every part once, or none: they are looked up.", code="invalid-parts")
    try:
        arrived = services.store.list_parts(row.object_key, row.s3_upload_id)
        refusal = _compare(services, row, arrived, completion)
        if refusal is None:
            services.store.complete_multipart(row.object_key, row.s3_upload_id, arrived)
    except UploadError as error:
        # An earlier try may have joined the parts and then lost its answer or its catalog.
        if not services.store.exists(row.object_key):
            raise invalid("parts", str(error), "PUT the parts again.", code="invalid-parts") from error
        services.store.abort_multipart(row.object_key, row.s3_upload_id)  # what such a try may have left of it
        return None
    return refusal


def _compare(services: Services, row: UploadRow, arrived: Sequence[Part], completion: Completion) -> ApiProblem | None:
    there = {part.number: part for part in arrived}
    missing = [number for number in range(1, row.parts + 1) if number not in there]
    if missing:
        what = f"{len(missing)} of {row.parts} parts have not arrived: {_some(missing)}"
        remedy = "POST …/parts for their URLs, PUT them, and complete the upload again."
        raise invalid("parts", what, remedy, code="invalid-parts")
    for part in arrived:
        wanted = part_length(part.number, row, services.settings)
        if part.size != wanted:
            what = f"part {part.number} has {part.size} bytes, {wanted} were announced"
            return invalid("size", what, "Upload the file again; nothing was kept.", code="wrong-size")
    named = {part.number: part.etag.strip('"') for part in completion.parts or ()}
    other = [number for number, etag in named.items() if there[number].etag != etag]
    if other:
        what = f"the etags of {len(other)} parts are not those of the bytes that arrived: {_some(other)}"
        remedy = "PUT those parts again and name each with the ETag of its answer."
        raise invalid("parts", what, remedy, code="invalid-parts")
    return None


def _some(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers[:_NAMED])) + (" …" if len(numbers) > _NAMED else "")
