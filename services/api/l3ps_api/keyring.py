"""From credentials to the caller they belong to."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import threading
import time
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

import structlog

from l3ps_platform.catalog import DEFAULT_PROJECT, ApiKeyRow, Catalog, keys, projects
from l3ps_platform.errors import CatalogUnavailable
from l3ps_platform.settings import Settings

log = structlog.get_logger(__name__)

Scope = Literal["read", "write", "admin"]
SCOPES: tuple[Scope, ...] = ("read", "write", "admin")
"""Each permits what those before it permit."""

SECRET = re.compile(rb"l3ps_(key_[0-9a-z]{25})_[A-Za-z0-9_-]{43}")
_NOBODY = "0" * 64
_REMEMBERED = 10_000
_USE_SECONDS = 60.0


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

    def may(self, scope: Scope) -> bool:
        """Whether it may do what needs this scope."""
        return SCOPES.index(self.scope) >= SCOPES.index(scope)


def new_secret(key_id: str) -> str:
    """A fresh secret of a key, 256 random bits behind the key's id."""
    return f"l3ps_{key_id}_{secrets.token_urlsafe(32)}"


def digest(secret: bytes | str) -> str:
    """What is kept of a secret. It is random, so a plain hash cannot be guessed back and none needs to be slow."""
    return hashlib.sha256(secret.encode() if isinstance(secret, str) else secret).hexdigest()


class Keyring:
    """Verifies credentials, and remembers for a moment those that were right."""

    def __init__(self, settings: Settings, catalog: Catalog) -> None:
        self._catalog, self._seconds = catalog, settings.key_cache_seconds
        self._operator = digest(settings.token.get_secret_value()) if settings.token else None
        self._open = settings.token is None and settings.loopback
        self._remembered: dict[tuple[str, str], tuple[Principal, float]] = {}
        self._lock, self._forgotten = threading.Lock(), 0

    def recall(self, secret: bytes | None, project: str) -> Principal | None:
        """The caller, if these credentials were right a moment ago. Costs no look into the catalog."""
        found = self._remembered.get((_NOBODY if secret is None else digest(secret), project))
        return found[0] if found is not None and found[1] > time.monotonic() else None

    def verify(self, secret: bytes | None, project: str) -> Principal | None:
        """The caller whose credentials these are, or None.

        Args:
            secret: what came as the bearer token.
            project: id of the project that the caller says it acts in; empty for its own.

        Raises:
            NotFound: the operator names a project that does not exist.
            PermissionError: a key names a project other than its own.
        """
        forgotten = self._forgotten
        found = self._verified(secret, project)
        name = _NOBODY if secret is None else digest(secret)
        with self._lock:
            if found is not None and forgotten == self._forgotten:  # else it may have been read before a revocation
                if len(self._remembered) >= _REMEMBERED:
                    self._remembered.clear()
                self._remembered[name, project] = (found, time.monotonic() + self._seconds)
        return found

    def forget(self, key_id: str | None = None) -> None:
        """No longer believe what is remembered of a key, or of any caller."""
        with self._lock:
            self._forgotten += 1
            self._remembered = {} if key_id is None else {
                name: found for name, found in self._remembered.items() if found[0].key_id != key_id
            }  # fmt: skip

    def _verified(self, secret: bytes | None, project: str) -> Principal | None:
        if secret is None:
            return self._acting_in(project) if self._open else None
        shaped = SECRET.fullmatch(secret)
        if shaped is not None:
            return self._key(shaped[1].decode(), digest(secret), project)
        if self._operator is not None and hmac.compare_digest(digest(secret), self._operator):
            return self._acting_in(project)
        return None

    def _acting_in(self, project: str) -> Principal:
        if project not in ("", DEFAULT_PROJECT):
            with self._catalog.reading() as session:
                projects.get(session, project)
        return Principal(project or DEFAULT_PROJECT, "admin")

    def _key(self, key_id: str, given: str, project: str) -> Principal | None:
        with self._catalog.reading() as session:
            row, now = keys.find(session, key_id), self._catalog.now(session)
        # Both comparisons, whatever is known of the key: how long it takes tells nothing.
        right = hmac.compare_digest(given, row.secret_sha256 if row else _NOBODY)
        rotated = row is not None and row.previous_until is not None and row.previous_until > now
        right |= hmac.compare_digest(given, (row.previous_sha256 if row and rotated else None) or _NOBODY)
        if row is None or not right or row.revoked_at is not None or (row.expires_at and row.expires_at <= now):
            return None
        if project not in ("", row.project_id):
            raise PermissionError(row.id)
        self._note_use(row, now)
        return Principal(row.project_id, row.scope, row.id)  # type: ignore[arg-type]

    def _note_use(self, row: ApiKeyRow, now: datetime) -> None:
        if row.last_used_at is not None and (now - row.last_used_at).total_seconds() < _USE_SECONDS:
            return
        try:
            with self._catalog.transaction() as tx:
                keys.note_use(tx, row.id, _USE_SECONDS)
        except CatalogUnavailable as error:  # read it could: the request need not fail for this
            log.warning("the use of a key was not noted", key=row.id, reason=str(error))
