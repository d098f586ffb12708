"""Rules: what becomes of objects that arrive in a bucket."""

from __future__ import annotations

from fastapi import APIRouter, Response

from l3ps_api.auth import PrincipalDep
from l3ps_api.rules import service
from l3ps_api.rules.schemas import Rule, RulePage, RuleRequest
from l3ps_api.services import Cursor, Limit, ServicesDep

router = APIRouter(prefix="/v1/rules", tags=["arrival"])


@router.post("", status_code=201)
def create_rule(request: RuleRequest, response: Response, services: ServicesDep, principal: PrincipalDep) -> Rule:
    """Make a job of every log that arrives in a bucket, once `POST /v1/notifications/s3` tells of it."""
    rule = service.create(services, principal.project_id, request)
    response.headers["Location"] = f"/v1/rules/{rule.id}"
    return rule


@router.get("")
def list_rules(services: ServicesDep, limit: Limit = 50, cursor: Cursor = None) -> RulePage:
    """Rules, newest first, each with what arrived last."""
    return service.page(services, limit, cursor)


@router.get("/{rule_id}")
def get_rule(rule_id: str, services: ServicesDep) -> Rule:
    """A rule and what arrived last."""
    return service.get(services, rule_id)


@router.delete("/{rule_id}", status_code=204)
def delete_rule(rule_id: str, services: ServicesDep) -> None:
    """Delete a rule. Its jobs stay; what it has seen is forgotten."""
    service.delete(services, rule_id)
