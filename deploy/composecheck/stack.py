"""The compose project under test, with ports, secrets, volumes and image tags of its own."""

from __future__ import annotations

import json
import os
import secrets
import socket
import sys
import urllib.parse
import urllib.request
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from composecheck.command import ROOT, CheckError, Docker, run

UP_SECONDS, BUILD_SECONDS, DOWN_SECONDS = 240, 1800, 180
_PORTS = ("L3PS_PORT", "MINIO_PORT", "PROMETHEUS_PORT")


class Stack:
    """One compose project; nothing is started before `up`.

    Args:
        docker: the engine. Its environment loses every ``L3PS_`` variable, which would outrank the settings here.
        work: folder for the settings file.
    """

    def __init__(self, docker: Docker, work: Path) -> None:
        self.docker, self.work = docker, work
        self.project = f"l3ps-check-{secrets.token_hex(3)}"
        # A CA bundle that this machine's programs are told to use is one that the builds need as well.
        bundle = os.environ.get("L3PS_BUILD_CA") or os.environ.get("SSL_CERT_FILE", "")
        docker.env = {name: value for name, value in docker.env.items() if not name.startswith("L3PS_")}
        env_file = work / "env"
        run(["sh", ROOT / "deploy" / "new-env.sh", env_file], docker.log, 10, docker.env)
        extra = dict(zip(_PORTS, map(str, _free_ports(len(_PORTS))), strict=True)) | {"L3PS_VERSION": self.project}
        extra |= {"L3PS_BUILD_CA": bundle} if bundle else {}
        with env_file.open("a") as file:
            file.writelines(f"{name}={value}\n" for name, value in extra.items())
        self.settings = dict(line.split("=", 1) for line in env_file.read_text().splitlines() if line[:1].isalpha())
        self._compose = ("compose", "--project-name", self.project, "--env-file", str(env_file))

    @property
    def url(self) -> str:
        """Where the API is published."""
        return f"http://127.0.0.1:{self.settings['L3PS_PORT']}"

    @property
    def objects(self) -> str:
        """host:port where the object store is published."""
        return f"127.0.0.1:{self.settings['MINIO_PORT']}"

    def compose(self, *words: str, seconds: float = 60) -> str:
        """Run ``docker compose WORDS`` on this project."""
        return self.docker.run(*self._compose, *words, seconds=seconds)

    def services(self) -> dict[str, Any]:
        """The services of the compose file, all variables filled in."""
        return dict(json.loads(self.compose("config", "--format", "json"))["services"])

    def images(self) -> tuple[list[str], list[str]]:
        """The images the compose file builds, and those of others."""
        services = self.services().values()
        built = {service["image"] for service in services if "build" in service}
        return sorted(built), sorted({service["image"] for service in services} - built)

    def build(self) -> dict[str, float]:
        """Build the images; name → megabytes."""
        self.compose("build", seconds=BUILD_SECONDS)
        built, _ = self.images()
        sizes = self.docker.run("image", "inspect", "--format", "{{.Size}}", *built).split()
        return {image.partition(":")[0]: int(size) / 1e6 for image, size in zip(built, sizes, strict=True)}

    def up(self) -> None:
        """Start everything and wait until all health checks pass."""
        self.compose("up", "--detach", "--wait", "--no-build", seconds=UP_SECONDS)

    def down(self, *options: str) -> None:
        """Remove the containers and networks."""
        self.compose("down", *options, seconds=DOWN_SECONDS)

    def cli(self, *words: str | Path, seconds: float = 120) -> str:
        """Run this machine's ``l3ps`` against the stack."""
        env = {**self.docker.env, "L3PS_URL": self.url, "L3PS_TOKEN": self.settings["L3PS_TOKEN"]}
        return run([Path(sys.executable).parent / "l3ps", *words], self.docker.log, seconds, env)

    def get(self, path: str) -> Any:
        """A JSON document of the API."""
        return get_json(self.url + path, {"Authorization": f"Bearer {self.settings['L3PS_TOKEN']}"})

    def prometheus(self, expression: str) -> float | None:
        """The first value of an instant query, None where there is no series."""
        query = urllib.parse.urlencode({"query": expression})
        answer = get_json(f"http://127.0.0.1:{self.settings['PROMETHEUS_PORT']}/api/v1/query?{query}")
        result = answer["data"]["result"]
        return float(result[0]["value"][1]) if result else None

    def assert_gone(self) -> None:
        """CheckError when a container, volume or network of the project is left."""
        for kind, all_of_them in {"container": ["--all"], "volume": [], "network": []}.items():
            label = f"label=com.docker.compose.project={self.project}"
            left = self.docker.run(kind, "ls", *all_of_them, "--quiet", "--filter", label).split()
            if left:
                raise CheckError(f"{len(left)} {kind}(s) of {self.project} are left.")


def get_json(url: str, headers: dict[str, str] | None = None) -> Any:
    """A JSON document by HTTP; OSError when there is none."""
    with urllib.request.urlopen(urllib.request.Request(url, headers=headers or {}), timeout=20) as answer:
        return json.load(answer)


def _free_ports(count: int) -> list[int]:
    with ExitStack() as held:
        probes = [held.enter_context(socket.socket()) for _ in range(count)]
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return [int(probe.getsockname()[1]) for probe in probes]
