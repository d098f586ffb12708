"""The images that are not built from this repository: present, pulled, or played by a stand-in."""

from __future__ import annotations

import shutil
from collections.abc import Iterable

from composecheck.command import INSTALL, ROOT, CheckError, Docker, run

BASES = ("python:3.11-slim-bookworm",)
STAND_IN_BASE = "debian:trixie-slim"
PULL_SECONDS, MAKE_SECONDS = 600, 600
_OFFLINE = ROOT / "deploy" / "offline"
_LABEL = '{{index .Config.Labels "l3ps.stand-in"}}'


def provide(docker: Docker, images: Iterable[str], offline: bool) -> list[str]:
    """Have the bases of the builds and ``images`` in the engine.

    Args:
        docker: the engine.
        images: names with tags, as the compose file gives them.
        offline: do not try to pull.

    Returns:
        Those that are played by stand-ins made of Debian's packages, this time or an earlier one.
    """
    wanted = [*BASES, *images]
    for image in wanted:
        if image in docker.images():
            continue
        if offline or not docker.works("pull", "--quiet", image, seconds=PULL_SECONDS):
            offline = True  # the next pull would fail as well, perhaps after a long wait
            _make_stand_in(docker, image)
    return [image for image in wanted if docker.run("image", "inspect", "--format", _LABEL, image).strip() == "true"]


def _make_stand_in(docker: Docker, image: str) -> None:
    if shutil.which("mmdebstrap") is None:
        raise CheckError(f"{image} can be neither pulled nor made: mmdebstrap is not installed. On Debian: {INSTALL}")
    base = image if image in BASES else STAND_IN_BASE
    if base not in docker.images():
        run(["sh", _OFFLINE / "base-images.sh", base], docker.log, MAKE_SECONDS, docker.env)
    if image != base:
        target = image.rpartition("/")[2].partition(":")[0]
        recipe = _OFFLINE / "stand-ins.Dockerfile"
        docker.run(
            "buildx", "build", "--file", recipe, "--target", target, "--tag", image, _OFFLINE, seconds=MAKE_SECONDS
        )
