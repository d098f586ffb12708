"""``l3ps webhooks``: the addresses that the service tells of events."""

from __future__ import annotations

from typing import Annotated

import typer

from l3ps_cli.console import AsJson, Limit, done, items_of, out, print_items, service_errors, state
from l3ps_client import Client

app = typer.Typer(help="Addresses that the service tells of events.", no_args_is_help=True)
Webhook = Annotated[str, typer.Argument(help="Id of a webhook.")]


@app.command()
def create(
    url: Annotated[str, typer.Argument(help="Where to POST events.")],
    event: Annotated[
        list[str] | None, typer.Option(help="Only this kind, such as job.succeeded or job.*; may be repeated.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Have events sent to a URL. The secret to verify them with is shown now and never again."""
    with service_errors(), Client() as client:
        webhook = client.webhooks.create(url, events=event or ())
    if as_json:
        out.print_json(data=webhook)
        return
    done(f"webhook {webhook['id']}: {webhook['url']}", as_json=False)
    done(webhook.get("secret") or "", as_json=False)


@app.command("list")
def listed(as_json: AsJson = False) -> None:
    """List the project's webhooks."""
    with service_errors(), Client() as client:
        page = items_of(client.webhooks.list())
    print_items(page, COLUMNS, as_json=as_json, nothing="No webhooks yet: `l3ps webhooks create URL` makes one.")


@app.command()
def delete(webhook: Webhook, as_json: AsJson = False) -> None:
    """Send nothing there any more."""
    with service_errors(), Client() as client:
        client.webhooks.delete(webhook)
    done(f"Webhook {webhook} is deleted.", {"id": webhook, "deleted": True}, as_json=as_json)


@app.command()
def test(webhook: Webhook, as_json: AsJson = False) -> None:
    """Send a test event there."""
    with service_errors(), Client() as client:
        answer = client.webhooks.test(webhook)
    done(f"A test event is on its way to webhook {webhook}.", answer, as_json=as_json)


@app.command()
def deliveries(webhook: Webhook, limit: Limit = 20, as_json: AsJson = False) -> None:
    """List what was sent there and how it fared, newest first."""
    with service_errors(), Client() as client:
        page = items_of(client.webhooks.deliveries(webhook, limit=limit))
    print_items(page, DELIVERIES, as_json=as_json, nothing="Nothing was sent there yet.")


@app.command()
def replay(
    webhook: Webhook,
    delivery: Annotated[str | None, typer.Option(help="Send this delivery again.")] = None,
    since: Annotated[str | None, typer.Option(help="Send what failed since this time (ISO 8601) again.")] = None,
    as_json: AsJson = False,
) -> None:
    """Send one delivery again, or all that failed since a time."""
    if (delivery is None) == (since is None):
        raise typer.BadParameter("name either --delivery or --since")
    with service_errors(), Client() as client:
        if delivery is not None:
            client.webhooks.redeliver(webhook, delivery)
            count = 1
        else:
            count = client.webhooks.replay(webhook, since=since or "")
    done(f"{count} on the way again.", {"count": count}, as_json=as_json)


COLUMNS = {
    "webhook": lambda webhook: webhook["id"],
    "url": lambda webhook: webhook["url"],
    "events": lambda webhook: ", ".join(webhook["events"] or ["all"]),
    "enabled": lambda webhook: "yes" if webhook["enabled"] else f"no: {webhook['disabled_reason'] or ''}",
    "made": lambda webhook: webhook["created_at"][:19],
}
DELIVERIES = {
    "delivery": lambda delivery: delivery["id"],
    "event": lambda delivery: delivery["type"],
    "state": lambda delivery: state(delivery["state"]),
    "tries": lambda delivery: str(delivery["attempts"]),
    "status": lambda delivery: str(delivery["last_status"] or ""),
    "why": lambda delivery: delivery["last_error"] or "",
}
