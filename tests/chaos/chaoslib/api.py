"""The API's real program, in which processes die at chosen points: ``python -m chaoslib.api``."""

import threading

from chaoslib import points
from l3ps_api.__main__ import main

_THREADS = {"reconciler": "reconciler", "sweeper": "sweeper", "webhooks": "deliverer", "deliverer": "deliverer"}
"""Whose life a thread lives, by how its name begins; all others answer requests."""


def whose_life() -> str:
    name = threading.current_thread().name
    return next((life for begins, life in _THREADS.items() if name.startswith(begins)), "requests")


if __name__ == "__main__":
    points.live(whose_life)
    points.arm()
    main()
