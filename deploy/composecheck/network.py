"""Give the host its network back after an engine of our own.

dockerd leaves its bridge, its firewall chains and, worse, a FORWARD policy of DROP behind when it ends, and a build
cut short leaves its interfaces.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_OURS = re.compile(r"docker0|br-[0-9a-f]{12}|veth[0-9a-f]{7}")
_FORWARDING = Path("/proc/sys/net/ipv4/ip_forward")
_EMPTY = {
    "filter": "*filter\n:INPUT ACCEPT\n:FORWARD ACCEPT\n:OUTPUT ACCEPT\nCOMMIT\n",
    "nat": "*nat\n:PREROUTING ACCEPT\n:INPUT ACCEPT\n:OUTPUT ACCEPT\n:POSTROUTING ACCEPT\nCOMMIT\n",
}


@contextmanager
def network_kept() -> Iterator[None]:
    """Remember interfaces, firewall and forwarding; put them back at the end."""
    links, forwarding = _links(), _FORWARDING.read_text()
    # A table that does not exist yet is not saved; to restore it is to empty it.
    tables = {name: _call("iptables-save", "--table", name) or empty for name, empty in _EMPTY.items()}
    try:
        yield
    finally:
        for link in _links() - links:
            if _OURS.fullmatch(link):
                _call("ip", "link", "delete", link)
        for rules in tables.values():
            _call("iptables-restore", given=rules)
        _FORWARDING.write_text(forwarding)


def _links() -> set[str]:
    return {path.name for path in Path("/sys/class/net").iterdir()}


def _call(*argv: str, given: str | None = None) -> str:
    """Run a network tool; what it prints. One that fails (its veth went with its peer) must not stop the others."""
    return subprocess.run(argv, input=given, capture_output=True, text=True, timeout=20, check=False).stdout
