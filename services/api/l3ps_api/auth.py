"""The bearer token."""

from __future__ import annotations

import hmac
from typing import Annotated

from fastapi import Header, Request

from l3ps_api.problems import ApiProblem, ErrorItem


def require_token(request: Request, authorization: Annotated[str | None, Header()] = None) -> None:
    """Let a request pass that carries the token of the settings; anything passes where there is none."""
    token: str | None = request.app.state.token
    if token is None:
        return
    scheme, _, given = (authorization or "").partition(" ")
    if scheme.lower() == "bearer" and hmac.compare_digest(given.strip().encode(), token.encode()):
        return
    what = "the token is not the service's" if authorization else "the header is missing"
    remedy = "Send `Authorization: Bearer TOKEN` (the command line reads L3PS_TOKEN)."
    raise ApiProblem(
        401,
        "unauthorized",
        "Unauthorized",
        f"Authorization: {what}. {remedy}",
        [ErrorItem(where="Authorization", what=what, remedy=remedy)],
        {"WWW-Authenticate": "Bearer"},
    )
