"""What the service tells by itself, and what it does by itself: events, webhooks, rules of arrival."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from l3ps_client._project_documents import Delivery, Rule, Webhook
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

    def create(self, url: str, *, events: Sequence[str] = (), description: str = "") -> Webhook:
        """Have events sent to a URL; ``secret``, which ``webhooks.verify`` needs, is in this answer and never again.

        Args:
            url: of the receiver: https, and a public address.
            events: only these kinds, such as ``job.succeeded`` or the group ``job.*``; all where empty.
            description: for whoever reads the list.
        """
        body = {"url": url, "events": [*events], "description": description}
        webhook: Webhook = self._wire.post(path("webhooks"), body)
        return webhook

    def get(self, webhook_id: str) -> Webhook:
        """A webhook, without its secret."""
        webhook: Webhook = self._wire.get(path("webhooks", webhook_id))
        return webhook

    def list(self, *, limit: int | None = None) -> Iterator[Webhook]:
        """Webhooks over all pages or the first ``limit``."""
        return items(self._wire, path("webhooks"), limit)

    def update(self, webhook_id: str, *, if_match: str | None = None, **fields: Any) -> Webhook:
        """Change ``url``, ``events``, ``description`` or ``enabled``; ``if_match``: only while its ETag is that."""
        where = path("webhooks", webhook_id)
        webhook: Webhook = self._wire.put(where, fields, method="PATCH", if_match=if_match)
        return webhook

    def delete(self, webhook_id: str) -> None:
        """Send nothing there any more."""
        self._wire.delete(path("webhooks", webhook_id))

    def rotate(self, webhook_id: str, *, overlap_seconds: int | None = None) -> Webhook:
        """Give a webhook a new secret; messages carry a signature by each for ``overlap_seconds``, or a day."""
        body = {} if overlap_seconds is None else {"overlap_seconds": overlap_seconds}
        webhook: Webhook = self._wire.post(path("webhooks", webhook_id, "rotate"), body)
        return webhook

    def test(self, webhook_id: str) -> Delivery:
        """Send a message of type ``ping`` there; the deliveries tell what came of it."""
        delivery: Delivery = self._wire.post(path("webhooks", webhook_id, "test"))
        return delivery

    def replay(self, webhook_id: str, *, since: str) -> int:
        """Make all deliveries that failed since a time (ISO 8601) again; how many they are."""
        return int(self._wire.post(path("webhooks", webhook_id, "replay"), {"since": since})["count"])

    def deliveries(self, webhook_id: str, *, limit: int | None = None, state: str | None = None) -> Iterator[Delivery]:
        """What was sent there and how it fared, newest first."""
        return items(self._wire, path("webhooks", webhook_id, "deliveries"), limit, state=state)

    def redeliver(self, webhook_id: str, delivery_id: str) -> Delivery:
        """Make one delivery again, under the same message id."""
        delivery: Delivery = self._wire.post(path("webhooks", webhook_id, "deliveries", delivery_id, "replay"))
        return delivery


class Rules(Group):
    """``client.rules``: what turns a finished upload of a bucket into a job; for keys of scope ``admin``."""

    def create(
        self, name: str, *, bucket: str, model: str, prefix: str = "", suffix: str | None = None, **settings: Any
    ) -> Rule:
        """Make a rule.

        Args:
            name: for whoever reads the list.
            bucket: which the service may read.
            model: name or id of a model.
            prefix: only objects below it; all of the bucket where empty.
            suffix: only objects whose key ends so; one such as ``_SUCCESS`` says that its folder is complete.
            settings: of the jobs, as of ``jobs.create``.
        """
        body = _fields(name=name, bucket=bucket, model=model, prefix=prefix, suffix=suffix, **settings)
        rule: Rule = self._wire.post(path("rules"), body)
        return rule

    def get(self, rule_id: str) -> Rule:
        """A rule and what arrived last."""
        rule: Rule = self._wire.get(path("rules", rule_id))
        return rule

    def list(self, *, limit: int | None = None) -> Iterator[Rule]:
        """Rules over all pages or the first ``limit``."""
        return items(self._wire, path("rules"), limit)

    def delete(self, rule_id: str) -> None:
        """Forget a rule; jobs it has made go on."""
        self._wire.delete(path("rules", rule_id))


def _fields(**fields: Any) -> dict[str, Any]:
    return {name: value for name, value in fields.items() if value is not None}
