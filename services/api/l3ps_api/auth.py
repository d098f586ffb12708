"""The bearer token."""

from __future__ import annotations

import hmac
from typing import Annotated

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from l3ps_api.problems import ApiProblem, ErrorItem

_bearer = HTTPBearer(auto_error=False, description="The token of the settings (L3PS_TOKEN), where there is one.")


def require_token(request: Request, given: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]) -> None:
    """Let a request pass that carries the token of the settings; anything passes where there is none."""
    token: str | None = request.app.state.token
    if token is None:
        return
    if given is not None and hmac.compare_digest(given.credentials.encode(), token.encode()):
        return
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
