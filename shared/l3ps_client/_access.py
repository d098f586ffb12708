"""Who may do what: projects, keys, and how long results are kept."""

from __future__ import annotations

from collections.abc import Iterator

from l3ps_client._project_documents import Key, Project, Retention
from l3ps_client._resource import Group, items, path


class Projects(Group):
    """``client.projects``: worlds that cannot see each other's drives, models or labels; for the operator."""

    def create(self, name: str) -> Project:
        """Make a project; its keys are made with ``L3PS-Project`` naming it."""
        project: Project = self._wire.post(path("projects"), {"name": name})
        return project

    def get(self, project_id: str) -> Project:
        """A project."""
        project: Project = self._wire.get(path("projects", project_id))
        return project

    def list(self, *, limit: int | None = None) -> Iterator[Project]:
        """Projects over all pages or the first ``limit``."""
        return items(self._wire, path("projects"), limit)

    def delete(self, project_id: str) -> None:
        """Delete a project."""
        self._wire.delete(path("projects", project_id))


class Keys(Group):
    """``client.keys``: the tokens of a project; for keys of scope ``admin``."""

    def create(self, name: str, scope: str, *, expires_at: str | None = None) -> Key:
        """Make a key; ``secret``, the token itself, is in this answer and never again.

        Args:
            name: what it is for.
            scope: ``read``, ``write`` or ``admin``.
            expires_at: ISO 8601 time after which it is refused; None for never.
        """
        body = {"name": name, "scope": scope} | ({"expires_at": expires_at} if expires_at else {})
        key: Key = self._wire.post(path("keys"), body)
        return key

    def get(self, key_id: str) -> Key:
        """A key, without its secret."""
        key: Key = self._wire.get(path("keys", key_id))
        return key

    def list(self, *, limit: int | None = None) -> Iterator[Key]:
        """Keys over all pages or the first ``limit``."""
        return items(self._wire, path("keys"), limit)

    def rotate(self, key_id: str, *, overlap_seconds: int | None = None) -> Key:
        """Give a key a new secret; the old one is taken for ``overlap_seconds`` more, or as configured."""
        body = {} if overlap_seconds is None else {"overlap_seconds": overlap_seconds}
        key: Key = self._wire.post(path("keys", key_id, "rotate"), body)
        return key

    def revoke(self, key_id: str) -> None:
        """Refuse a key from now on."""
        self._wire.delete(path("keys", key_id))


class RetentionRules(Group):
    """``client.retention``: how long and how much a project keeps."""

    def get(self) -> Retention:
        """The bounds; None where there is none."""
        retention: Retention = self._wire.get(path("retention"))
        return retention

    def set(self, *, max_age_days: int | None = None, max_bytes: int | None = None) -> Retention:
        """Set both bounds; None lifts one."""
        body = {"max_age_days": max_age_days, "max_bytes": max_bytes}
        retention: Retention = self._wire.put(path("retention"), body)
        return retention
