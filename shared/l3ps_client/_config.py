"""Where the service is and who asks: arguments, then the environment, then a stack that runs on this machine."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

DEFAULT_URL = "http://127.0.0.1:8080"


@dataclass(frozen=True)
class Config:
    """Where to send requests and with what.

    Attributes:
        url: base address without a trailing slash.
        token: bearer token, None for none.
        project: id of the project that the operator acts in, None for the default or the key's own.
    """

    url: str
    token: str | None
    project: str | None

    @classmethod
    def of(cls, url: str | None, token: str | None, project: str | None) -> Config:
        """Complete what was given from ``L3PS_URL``, ``L3PS_TOKEN``, ``L3PS_PROJECT`` and a local ``l3ps up``.

        The local stack's token goes to the local stack only, whatever address is asked for.
        """
        local = _local_stack()
        url = (url or os.environ.get("L3PS_URL") or (local.url if local else DEFAULT_URL)).rstrip("/")
        token = token or os.environ.get("L3PS_TOKEN") or (local.token if local and local.url == url else None)
        return cls(url, token, project or os.environ.get("L3PS_PROJECT") or None)


def _local_stack() -> Config | None:
    """The stack of ``l3ps up`` in its default directory, where its process lives."""
    data = Path(os.environ.get("L3PS_DATA_DIR") or "~/.local/share/l3ps").expanduser()
    try:
        note = json.loads((data / "up.json").read_text())
        os.kill(int(note["pid"]), 0)
        return Config(str(note["url"]).rstrip("/"), note.get("token"), None)
    except (OSError, ValueError, KeyError, TypeError):
        return None  # none runs, one was killed, or it is somebody else's


def cache_folder() -> Path:
    """Where notes of unfinished uploads are kept: the user's cache folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "l3ps" / "uploads"
