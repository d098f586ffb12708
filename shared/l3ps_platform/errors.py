"""The platform's branch of the error tree.

l3ps.errors.L3psError
└── PlatformError
    ├── StoreError              the object store
    │   ├── StoreUnavailable    it does not answer, or not to us; trying again later may help
    │   │   └── OutputDoomed    the stage output is being deleted; in a moment it can be made anew
    │   ├── ObjectMissing       there is no object under this key
    │   ├── InvalidKey          the key could leave the store or would not survive a round trip
    │   ├── UploadError         a multipart upload that is unknown, or whose parts do not fit together
    │   └── InvalidSignature    a presigned URL that is forged, altered or out of date
    ├── CatalogUnavailable      the database does not answer
    ├── QueueUnavailable        Redis does not answer
    ├── NotFound                no such row (carries kind and id)
    ├── Conflict                the request does not fit the state of the row
    └── LeaseLost               another worker owns the stage now; drop everything and return
"""

from __future__ import annotations

from l3ps.errors import L3psError


class PlatformError(L3psError):
    """Root of what settings, catalog, object store and queue raise on purpose."""


class StoreError(PlatformError):
    """The object store refused or failed."""


class StoreUnavailable(StoreError):  # noqa: N818
    """The object store does not answer, or not to these credentials."""


class OutputDoomed(StoreUnavailable):
    """A stage output is being deleted: in a moment it can be made anew."""


class ObjectMissing(StoreError):  # noqa: N818
    """There is no object under this key."""

    def __init__(self, key: str) -> None:
        self.key = key
        super().__init__(f"there is no object {key!r} in the store")


class InvalidKey(StoreError):  # noqa: N818
    """A key that could leave the store or would not survive a round trip."""


class UploadError(StoreError):
    """A multipart upload that is unknown, or whose parts do not fit together."""


class InvalidSignature(StoreError):  # noqa: N818
    """A presigned URL that is forged, altered or out of date."""


class CatalogUnavailable(PlatformError):  # noqa: N818
    """The database does not answer."""


class QueueUnavailable(PlatformError):  # noqa: N818
    """Redis does not answer."""


class NotFound(PlatformError):  # noqa: N818
    """There is no such row.

    Attributes:
        kind: what was looked for: ``drive``, ``job``, ``model``, ``upload``, ``stage``.
        id: the id or name that was asked for.
    """

    def __init__(self, kind: str, id: str) -> None:
        self.kind = kind
        self.id = id
        super().__init__(f"there is no {kind} {id!r}")


class Conflict(PlatformError):  # noqa: N818
    """The request does not fit the state of the row; the message says which state and what to do."""


class LeaseLost(PlatformError):  # noqa: N818
    """Another worker owns the stage now, or nobody: drop everything and return."""


class TargetRefused(PlatformError):  # noqa: N818
    """A webhook may not be sent to this URL.

    Attributes:
        what: what is wrong with it.
        remedy: what to do.
    """

    def __init__(self, what: str, remedy: str) -> None:
        self.what, self.remedy = what, remedy
        super().__init__(what)
