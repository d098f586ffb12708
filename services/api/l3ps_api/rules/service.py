"""Rules."""

from __future__ import annotations

from l3ps_api.pages import cut
from l3ps_api.problems import conflict
from l3ps_api.rules.schemas import Rule, RulePage, RuleRequest
from l3ps_api.services import Services
from l3ps_api.sources import permitted
from l3ps_platform.catalog import bundles, rules
from l3ps_platform.errors import Conflict

MAX_RULES = 50
"""In a project: each object that a notification tells of is held against them all."""
_OWN = {"name", "bucket", "prefix", "suffix"}


def create(services: Services, project_id: str, request: RuleRequest) -> Rule:
    """A new rule. NotFound for its model, 403 for a place that is no source, 409 for a name that is taken or for too
    many."""
    place = permitted(services, project_id, f"s3://{request.bucket}/{request.prefix.strip('/')}", "prefix")
    settings = request.model_dump(exclude=_OWN)
    try:
        with services.catalog.transaction() as tx:
            if rules.count(tx.session) >= MAX_RULES:
                detail = f"The project has {MAX_RULES} rules, which is as many as there can be. Delete one first."
                raise conflict("too-many-rules", "Too many rules", detail, where="name", remedy="Delete one first.")
            bundles.by_name(tx.session, request.model)
            row = rules.add(
                tx, name=request.name, bucket=place.bucket, prefix=place.path, suffix=request.suffix, settings=settings
            )
    except Conflict as error:
        detail = f"{str(error)[:1].upper()}{str(error)[1:]}."
        remedy = "Delete that rule first, or choose another name."
        raise conflict("name-taken", "The name is taken", detail, where="name", remedy=remedy) from error
    return Rule.of(row)


def page(services: Services, limit: int, cursor: str | None) -> RulePage:
    """One page, newest first."""
    with services.catalog.reading() as session:
        rows = rules.page(session, limit=limit + 1, before=cursor)
        shown, following = cut(rows, limit)
        seen = rules.arrived(session, [row.id for row in shown])
    items = [Rule.of(row, *seen.get(row.id, (0, None))) for row in shown]
    return RulePage(items=items, next=following)


def get(services: Services, rule_id: str) -> Rule:
    """One rule. NotFound."""
    with services.catalog.reading() as session:
        row = rules.get(session, rule_id)
        return Rule.of(row, *rules.arrived(session, [row.id]).get(row.id, (0, None)))


def delete(services: Services, rule_id: str) -> None:
    """Delete a rule; its jobs stay. NotFound."""
    with services.catalog.transaction() as tx:
        rules.delete(tx, rule_id)
