"""``l3ps up`` as the service of a scenario: SQLite, a directory for the objects, and Redis, API and worker below it."""

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from signal import SIGTERM
from typing import Any

import redis

from chaoslib.proxy import Rule
from chaoslib.servers import descendants, left, wait_until
from chaoslib.stack import Service
from l3ps_cli.stack import free_port
from l3ps_platform.processes import Child
from l3ps_platform.settings import Settings

_STOPS = ((SIGTERM, 30.0),)
"""The stack gives its own children their time."""
_UP = "from l3ps_cli.main import app; app()"


class Embedded(Service):
    """One process to start and to kill; what is below it goes with it."""

    def _places(self, rules: Sequence[Rule]) -> dict[str, Any]:
        return {"data_dir": self.folder / "data", "port": free_port()}

    def _direct(self) -> Settings:
        return self.settings

    def start_api(self, name: str = "up", port: int | None = None) -> Child:
        """The whole stack, until it is up."""
        options = ["--data", str(self.settings.data_dir), "--port", str(self.settings.port), "--threads", "1"]
        command = [sys.executable, "-P", "-c", _UP, "up", *options, "--workers", "2"]
        self.api = self._start(name, command, self.env, _STOPS)
        note = self.settings.data_dir / "up.json"
        wait_until(lambda: self._pid_of(note) == self.api.pid or not self.api.running(), "it did not come up", 90)
        return self.api

    def below(self, program: str) -> int:
        """The process below the stack whose command line says this; its children have the same, it comes first."""
        lines = {pid: Path(f"/proc/{pid}/cmdline").read_bytes().decode() for pid in descendants(self.api.pid)}
        return next(pid for pid, line in lines.items() if program in line)

    def messages_left(self) -> dict[str, int]:
        conf = (self.settings.data_dir / "redis" / "redis.conf").read_text()
        found = dict(re.findall(r"^(port|requirepass) (\S+)$", conf, re.MULTILINE))
        with redis.Redis(port=int(found["port"]), password=found["requirepass"]) as client:
            return left(client)

    def multipart_uploads(self) -> list[str]:
        return [one.upload_id for one in self.store.list_multipart()]

    @staticmethod
    def _pid_of(note: Path) -> int | None:
        """Of the stack that says in its directory that it is up."""
        found = re.search(r'"pid": (\d+)', note.read_text()) if note.exists() else None
        return int(found[1]) if found else None
