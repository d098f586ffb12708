"""``l3ps whoami``: which service this is, and who it takes the caller for."""

from __future__ import annotations

from l3ps_cli.console import AsJson, out, service_errors
from l3ps_client import Client


def whoami(as_json: AsJson = False) -> None:
    """Say which service the commands talk to, in which project, and what they may do."""
    with service_errors(), Client() as client:
        me, url = client.me(), client.url
    if as_json:
        out.print_json(data=me | {"url": url})
        return
    key = me["key"]
    who = f"key {key['name']} ({key['id']})" if key else "the operator"
    text = f"{url}: {who}, scope {me['scope']}, in project {me['project']['name']} ({me['project']['id']})"
    out.print(text, markup=False, highlight=False, soft_wrap=True)
