"""API keys: made, shown once, rotated, revoked."""

from __future__ import annotations

from datetime import UTC, datetime

from l3ps_api.keyring import digest, new_secret
from l3ps_api.keys.schemas import Key, KeyPage, KeyRequest, KeyWithSecret
from l3ps_api.pages import cut
from l3ps_api.problems import invalid
from l3ps_api.services import Services
from l3ps_platform.catalog import ApiKeyRow, keys
from l3ps_platform.catalog.requests import note_result
from l3ps_platform.ids import new_id


def create(services: Services, request: KeyRequest, maker: str | None) -> KeyWithSecret:
    """A new key with its secret, made by the key ``maker`` or the operator. Conflict when that key has ended."""
    if request.expires_at is not None and request.expires_at <= datetime.now(UTC):
        raise invalid("expires_at", f"{request.expires_at.isoformat()} is past", "Name a time to come.")
    id = new_id("key")
    secret = new_secret(id)
    with services.catalog.transaction() as tx:
        keys.hold_maker(tx, maker)
        row = keys.add(
            tx, id=id, name=request.name, scope=request.scope, secret_sha256=digest(secret),
            expires_at=request.expires_at,
        )  # fmt: skip
    return _shown(row, secret)


def page(services: Services, limit: int, cursor: str | None) -> KeyPage:
    """One page, newest first."""
    with services.catalog.reading() as session:
        rows = keys.page(session, limit=limit + 1, before=cursor)
    shown, following = cut(rows, limit)
    return KeyPage(items=[Key.of(row) for row in shown], next=following)


def get(services: Services, key_id: str) -> Key:
    """One key. NotFound."""
    with services.catalog.reading() as session:
        return Key.of(keys.get(session, key_id))


def revoke(services: Services, key_id: str) -> None:
    """End a key. NotFound."""
    with services.catalog.transaction() as tx:
        keys.revoke(tx, key_id)


def rotate(services: Services, key_id: str, maker: str | None, overlap_seconds: int = 0) -> KeyWithSecret:
    """Give a key a new secret. NotFound; Conflict when it, or the key ``maker`` that asks for it, has ended."""
    secret = new_secret(key_id)
    with services.catalog.transaction() as tx:
        keys.hold_maker(tx, maker, changed=key_id)
        row = keys.rotate(tx, key_id, digest(secret), overlap_seconds)
        note_result(tx.session, "api_keys", key_id)
    return _shown(row, secret)


def shown_again(services: Services, key_id: str) -> KeyWithSecret:
    """The answer of a request that was cut off after it had made or rotated a key.

    Nobody has seen the secret it made, so a new one takes its place. NotFound.
    """
    secret = new_secret(key_id)
    with services.catalog.transaction() as tx:
        return _shown(keys.renew(tx, key_id, digest(secret)), secret)


def _shown(row: ApiKeyRow, secret: str) -> KeyWithSecret:
    return KeyWithSecret(**Key.of(row).model_dump(), secret=secret)
