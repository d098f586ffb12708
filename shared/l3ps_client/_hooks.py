"""What the service tells by itself, and what it does by itself: events, webhooks, rules of arrival."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from l3ps_client._documents import Delivery, Rule, Webhook
from l3ps_client._resource import Group, items, path
from l3ps_client._sse import Event
from l3ps_client._watching import follow


class Events(Group):
    """``client.events``: what happens in a project."""

    def follow(self, *, kinds: Sequence[str] = (), after: str | None = None) -> Iterator[Event]:
        """Events as they happen, without an end; a broken connection is taken up where it was.

        Args:
            kinds: only these, such as ``job.succeeded``; all where empty.
            after: id of the last event that is known already.
        """
        params = {"kinds": ",".join(kinds)} if kinds else {}
        return follow(self._wire, path("events"), params, after)


class Webhooks(Group):
    """``client.webhooks``: addresses that the service tells of events; for keys of scope ``admin``."""

    def create(self, url: str, *, kinds: Sequence[str] | None = None, **fields: Any) -> Webhook:
        """Have events sent to a URL; ``secret``, which ``webhooks.verify`` needs, is in this answer and never again."""
        webhook: Webhook = self._wire.post(path("webhooks"), _fields(url=url, kinds=kinds, **fields))
        return webhook

    def get(self, webhook_id: str) -> Webhook:
        """A webhook, without its secret."""
        webhook: Webhook = self._wire.get(path("webhooks", webhook_id))
        return webhook

    def list(self, *, limit: int | None = None) -> Iterator[Webhook]:
        """Webhooks over all pages or the first ``limit``."""
        return items(self._wire, path("webhooks"), limit)

    def update(self, webhook_id: str, *, if_match: str | None = None, **fields: Any) -> Webhook:
        """Change fields of a webhook; with ``if_match`` only where its ETag is still that."""
        where = path("webhooks", webhook_id)
        webhook: Webhook = self._wire.put(where, fields, method="PATCH", if_match=if_match)
        return webhook

    def delete(self, webhook_id: str) -> None:
        """Send nothing there any more."""
        self._wire.delete(path("webhooks", webhook_id))

    def rotate(self, webhook_id: str) -> Webhook:
        """Give a webhook a new secret; deliveries are signed with both for a while."""
        webhook: Webhook = self._wire.post(path("webhooks", webhook_id, "rotate"))
        return webhook

    def test(self, webhook_id: str) -> Any:
        """Send a test event there."""
        return self._wire.post(path("webhooks", webhook_id, "test"))

    def replay(self, webhook_id: str, *, since: str) -> Any:
        """Send all events since a time (ISO 8601) again."""
        return self._wire.post(path("webhooks", webhook_id, "replay"), {"since": since})

    def deliveries(self, webhook_id: str, *, limit: int | None = None) -> Iterator[Delivery]:
        """What was sent there and how it fared, newest first."""
        return items(self._wire, path("webhooks", webhook_id, "deliveries"), limit)

    def redeliver(self, webhook_id: str, delivery_id: str) -> Any:
        """Send one delivery again."""
        return self._wire.post(path("webhooks", webhook_id, "deliveries", delivery_id, "replay"))


class Rules(Group):
    """``client.rules``: what turns a finished upload of a bucket into a job; for keys of scope ``admin``."""

    def create(self, **fields: Any) -> Rule:
        """Make a rule; fields as ``/openapi.json`` describes them."""
        rule: Rule = self._wire.post(path("rules"), fields)
        return rule

    def list(self, *, limit: int | None = None) -> Iterator[Rule]:
        """Rules over all pages or the first ``limit``."""
        return items(self._wire, path("rules"), limit)

    def delete(self, rule_id: str) -> None:
        """Forget a rule; jobs it has made go on."""
        self._wire.delete(path("rules", rule_id))


def _fields(**fields: Any) -> dict[str, Any]:
    return {name: value for name, value in fields.items() if value is not None}
