"""The real API, killed outright at a step of its work that is told, and then started again: run as a program.

A step is a commit of a request, or what a request does to the object store: the process can end right before each and
right behind it. A line with a number on standard input is the step, counted from then on and from 1, at which it ends,
0 for never; the answer "died" or "lived" tells of the number before. The port is held all the time, as by the balancer
of a fleet, so that clients meet no refused connection but one that breaks off.
"""

import functools
import mmap
import os
import select
import signal
import socket
import sys
import threading

import uvicorn
from fastapi import FastAPI
from sqlalchemy import event
from sqlalchemy.orm import Session, configure_mappers

from l3ps_api.__main__ import Server
from l3ps_api.app import create_app
from l3ps_api.operations import operations_of
from l3ps_platform.objects.files import Incoming
from l3ps_platform.objects.folder_uploads import FolderUploads
from l3ps_platform.settings import get_settings
from l3ps_platform.telemetry import configure_logging

CHORES = ("reconciler", "deliverer")
STORE = ("create_multipart", "complete_multipart", "abort_multipart", "delete")


class Steps:
    """Counts what processes do, and ends the one that takes the step that is told."""

    def __init__(self) -> None:
        self._left = mmap.mmap(-1, 4)  # shared with the processes that are forked

    def end_at(self, step: int) -> None:
        """Begin to count; 0 for never."""
        self._left[:] = step.to_bytes(4)

    def step(self, *_: object) -> None:
        """Another one."""
        left = int.from_bytes(self._left[:])
        if left and threading.current_thread().name not in CHORES:
            self.end_at(left - 1)
            if left == 1:
                os.kill(os.getpid(), signal.SIGKILL)

    def around(self, owner: type, name: str) -> None:
        """Calls of a method are two steps."""
        original = getattr(owner, name)

        @functools.wraps(original)
        def counted(*arguments, **named):
            self.step()
            result = original(*arguments, **named)
            self.step()
            return result

        setattr(owner, name, counted)


def serve(app: FastAPI, listener: socket.socket) -> int:
    """Start an API process; something that can be read from when it has ended."""
    pid = os.fork()
    if pid:
        return os.pidfd_open(pid)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    config = uvicorn.Config(app, log_config=None, access_log=False)
    Server(config, app.state.events).run([listener])
    os._exit(0)


def main() -> None:
    """Serve until standard input ends."""
    settings, steps = get_settings(), Steps()
    configure_logging(settings, "api")
    app = create_app(settings)
    for name in ("before_commit", "after_commit"):
        event.listen(Session, name, steps.step)
    for name in STORE:
        steps.around(type(app.state.services.store), name)
    steps.around(Incoming, "check")
    for name in ("put", "drop"):
        steps.around(FolderUploads, name)
    operations_of(app)  # the work of a first request, once for all processes
    configure_mappers()
    with socket.create_server((settings.host, settings.port)) as listener:
        child, died = serve(app, listener), False
        while True:
            ready, _, _ = select.select([sys.stdin, child], [], [])
            if child in ready:
                os.waitid(os.P_PIDFD, child, os.WEXITED)
                os.close(child)
                child, died = serve(app, listener), True
                continue
            line = sys.stdin.readline()
            if not line:
                signal.pidfd_send_signal(child, signal.SIGKILL)
                return
            sys.stdout.write("died\n" if died else "lived\n")
            sys.stdout.flush()
            steps.end_at(int(line))
            died = False


if __name__ == "__main__":
    main()
