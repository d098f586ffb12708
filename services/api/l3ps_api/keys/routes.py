"""API keys of the caller's project."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Request, Response

from l3ps_api.auth import PrincipalDep
from l3ps_api.keys import service
from l3ps_api.keys.schemas import Key, KeyPage, KeyRequest, KeyWithSecret, Rotation
from l3ps_api.services import Cursor, Limit, ServicesDep, id_of

router = APIRouter(prefix="/v1/keys", tags=["access"])
KeyCursor = Annotated[Cursor, id_of("key")]


@router.post("", status_code=201)
def create_key(
    request: KeyRequest, response: Response, services: ServicesDep, principal: PrincipalDep
) -> KeyWithSecret:  # fmt: skip
    """Make a key. Its secret is in this answer and nowhere else."""
    key = service.create(services, request, principal.key_id)
    response.headers["Location"] = f"/v1/keys/{key.id}"
    response.headers["Cache-Control"] = "no-store"
    return key


@router.get("")
def list_keys(services: ServicesDep, limit: Limit = 50, cursor: KeyCursor = None) -> KeyPage:
    """Keys, newest first, revoked ones too."""
    return service.page(services, limit, cursor)


@router.get("/{key_id}")
def get_key(key_id: str, services: ServicesDep) -> Key:
    """A key, without its secret."""
    return service.get(services, key_id)


@router.delete("/{key_id}", status_code=204)
def revoke_key(key_id: str, services: ServicesDep, http: Request) -> None:
    """Revoke a key; it stays in the list."""
    service.revoke(services, key_id)
    http.app.state.keyring.forget(key_id)


@router.post("/{key_id}/rotate")
def rotate_key(
    key_id: str, services: ServicesDep, principal: PrincipalDep, http: Request, response: Response,
    rotation: Rotation | None = None,
) -> KeyWithSecret:  # fmt: skip
    """Give a key a new secret. The old one ends at once, or after `overlap_seconds`."""
    key = service.rotate(services, key_id, principal.key_id, rotation.overlap_seconds if rotation else 0)
    http.app.state.keyring.forget(key_id)
    response.headers["Cache-Control"] = "no-store"
    return key
