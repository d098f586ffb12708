"""Whether a client's ``s3://bucket/prefix`` may be read."""

from __future__ import annotations

from l3ps_api.problems import ApiProblem, ErrorItem, invalid
from l3ps_api.services import Services
from l3ps_platform.objects import Reference, find_source


def permitted(services: Services, project_id: str, text: str, where: str = "source") -> Reference:
    """The place a client names. 422 where it is none, 403 where this project may not read."""
    try:
        reference = Reference.parse(text)
    except ValueError as error:
        remedy = "Name a log as s3://bucket/prefix, in letters as the bucket has them."
        raise invalid(where, str(error), remedy, code="bad-source") from error
    if find_source(services.settings, reference, project_id) is None:
        what = f"{reference} lies in no place that this project may read"
        remedy = "Ask whoever runs the service to add it to L3PS_SOURCES, or upload the log."
        item = ErrorItem(where=where, what=what, remedy=remedy)
        raise ApiProblem(403, "source-not-allowed", "Not a source", f"{where}: {what}. {remedy}", [item])
    return reference
