"""Who asks: the bearer token, and what it permits."""

from __future__ import annotations

import hmac
from dataclasses import dataclass
from typing import Annotated, Literal

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from l3ps_api.problems import ApiProblem, ErrorItem
from l3ps_platform.catalog import DEFAULT_PROJECT

Scope = Literal["read", "write", "admin"]

_bearer = HTTPBearer(auto_error=False, description="The token of the settings (L3PS_TOKEN), where there is one.")


@dataclass(frozen=True, slots=True)
class Principal:
    """The caller.

    Attributes:
        project_id: whose rows it sees.
        scope: what it may do there.
        key_id: its API key; None for the operator, who holds the token of the settings.
    """

    project_id: str
    scope: Scope
    key_id: str | None = None


def authenticate(
    request: Request, given: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]
) -> Principal:
    """Let a request pass that carries the token of the settings; anything passes where there is none."""
    token: str | None = request.app.state.token
    operator = Principal(DEFAULT_PROJECT, "admin")
    if token is None:
        return operator
    if given is not None and hmac.compare_digest(given.credentials.encode(), token.encode()):
        return operator
    what = "the token is not the service's" if given is not None else "the bearer token is missing"
    remedy = "Send `Authorization: Bearer TOKEN` (the command line reads L3PS_TOKEN)."
    raise ApiProblem(
        401,
        "unauthorized",
        "Unauthorized",
        f"Authorization: {what}. {remedy}",
        [ErrorItem(where="Authorization", what=what, remedy=remedy)],
        headers={"WWW-Authenticate": "Bearer"},
    )


PrincipalDep = Annotated[Principal, Depends(authenticate)]
