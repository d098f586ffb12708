"""Running commands, bounded in time, their output kept."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
INSTALL = "sudo sh deploy/offline/install-engine.sh"
_SHOWN_WORDS, _SHOWN_LINES = 12, 15


class CheckError(Exception):
    """The check cannot go on, or what it looked at is wrong; the message says what and what to do."""


def run(words: Sequence[str | Path], log: Path, seconds: float, env: Mapping[str, str]) -> str:
    """Run a command in the repository's root.

    Args:
        words: program and arguments; no shell is involved.
        log: file that its output is appended to.
        seconds: how long it may take.
        env: its whole environment.

    Returns:
        Its standard output.

    Raises:
        CheckError: it failed (with the end of its output), took too long, or is not installed.
    """
    argv = [str(word) for word in words]
    said = f"`{' '.join(argv[:_SHOWN_WORDS])}{' …' if len(argv) > _SHOWN_WORDS else ''}`"
    with log.open("ab") as sink:
        sink.write(f"\n$ {' '.join(argv)}\n".encode())
        try:
            done = subprocess.run(
                argv,
                cwd=ROOT,
                env=dict(env),
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=seconds,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            sink.write((error.stdout or b"") + (error.stderr or b""))
            raise CheckError(f"{said} did not end within {seconds:.0f} s.") from error
        except FileNotFoundError as error:
            raise CheckError(f"{argv[0]} is not installed.") from error
        sink.write(done.stdout + done.stderr)
    if done.returncode:
        tail = (done.stdout + done.stderr).decode(errors="replace").strip().splitlines()[-_SHOWN_LINES:]
        raise CheckError(f"{said} failed with status {done.returncode}:\n    " + "\n    ".join(tail))
    return done.stdout.decode(errors="replace")


@dataclass
class Docker:
    """The command line client, bound to one engine.

    Attributes:
        log: file that takes the output of every command.
        env: environment of the commands; DOCKER_HOST names the engine.
        own: whether this process started the engine and will stop it.
    """

    log: Path
    env: dict[str, str] = field(repr=False)
    own: bool = False

    def run(self, *words: str | Path, seconds: float = 60) -> str:
        """Run ``docker WORDS``; its standard output. CheckError when it fails or takes longer than ``seconds``."""
        return run(["docker", *words], self.log, seconds, self.env)

    def works(self, *words: str | Path, seconds: float = 60) -> bool:
        """Whether ``docker WORDS`` ends with success."""
        with suppress(CheckError):
            self.run(*words, seconds=seconds)
            return True
        return False

    def images(self) -> set[str]:
        """The tags of all images."""
        return set(self.run("image", "ls", "--format", "{{.Repository}}:{{.Tag}}").split())
