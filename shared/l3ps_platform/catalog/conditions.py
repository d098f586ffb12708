"""Changes that happen only if the document they change is still the one their client has seen.

The client's condition is looked at once more right before the commit. By then the change is flushed and holds its rows:
whoever else changes them has committed and is seen, or waits for this commit. So of two changes on the same condition
one fails, in one process as in several.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from sqlalchemy import event
from sqlalchemy.orm import Session


class _Condition:
    """``check`` raises where the condition no longer holds; it sees what others have committed."""

    def __init__(self, check: Callable[[], None]) -> None:
        self.check, self.met = check, False


_current: ContextVar[_Condition | None] = ContextVar("l3ps_condition", default=None)


@contextmanager
def only_if(check: Callable[[], None]) -> Iterator[None]:
    """The first commit inside, in this context and the threads that inherit it, needs ``check`` not to raise.

    What a request commits after its change follows from that, and finds the document changed by the request itself.
    """
    token = _current.set(_Condition(check))
    try:
        yield
    finally:
        _current.reset(token)


@event.listens_for(Session, "before_commit")
def _look_again(session: Session) -> None:
    condition = _current.get()
    if condition is None or condition.met or session.in_nested_transaction():
        return
    session.flush()
    condition.check()
    condition.met = True
