"""Keys: what may name an object, and how foreign names become part of a key."""

from __future__ import annotations

import hashlib
import mimetypes
import re
from urllib.parse import quote

from l3ps_platform.errors import InvalidKey

_SEGMENT = re.compile(r"[A-Za-z0-9_=+@][A-Za-z0-9._=+@-]*")
_UNSAFE = re.compile(r"[^A-Za-z0-9._+@-]")
MAX_KEY = 900  # S3 allows 1024 bytes; a file name on disk 255
MAX_SEGMENT = 240

_TYPES = {
    ".json": "application/json",
    ".npz": "application/x-npz",
    ".zip": "application/zip",
    ".tar": "application/x-tar",
    ".gz": "application/gzip",
    ".zst": "application/zstd",
    ".txt": "text/plain; charset=utf-8",
    ".bin": "application/octet-stream",
    ".label": "application/octet-stream",
}


def check_key(key: str) -> str:
    """Return ``key`` if it can name an object in every store, else raise InvalidKey.

    Allowed are segments of ``[A-Za-z0-9._=+@-]`` that do not start with a dot or a dash, joined by single slashes: no
    ``..``, no absolute path, no drive letter, nothing that URL quoting changes the meaning of.
    """
    segments = key.split("/")
    if len(key) > MAX_KEY or not all(_SEGMENT.fullmatch(s) and len(s) <= MAX_SEGMENT for s in segments):
        raise InvalidKey(
            f"{key[:120]!r} is not an object key: use letters, digits and ._=+@- in parts joined by slashes"
        )
    return key


def check_prefix(prefix: str) -> str:
    """Return ``prefix`` if it is empty or a key followed by a slash, else raise InvalidKey."""
    if prefix and not prefix.endswith("/"):
        raise InvalidKey(f"{prefix[:120]!r} is not a prefix: it ends with a slash")
    if prefix:
        check_key(prefix[:-1])
    return prefix


def segment(name: str) -> str:
    """A foreign name (a token, a file name) as one key segment; different names stay different.

    Every byte outside the safe set becomes ``=XX``; names too long for a file system keep their beginning and get a
    digest for the rest.
    """
    quoted = _UNSAFE.sub(lambda m: "".join(f"={byte:02X}" for byte in m[0].encode()), name)
    if not quoted or quoted[0] in ".-":
        quoted = f"={ord(quoted[0]):02X}{quoted[1:]}" if quoted else "="
    if len(quoted) > MAX_SEGMENT:
        quoted = f"{quoted[: MAX_SEGMENT - 40]}={hashlib.sha256(name.encode()).hexdigest()[:39]}"
    return quoted


def attachment(filename: str) -> str:
    """The Content-Disposition that makes a browser save a download under a name, whatever is in it (RFC 6266)."""
    return f"attachment; filename*=UTF-8''{quote(filename, safe='')}"


def content_type(key: str) -> str:
    """The media type by the key's suffix; the same in every store."""
    suffix = "." + key.rsplit(".", 1)[-1].lower() if "." in key.rsplit("/", 1)[-1] else ""
    return _TYPES.get(suffix) or mimetypes.types_map.get(suffix, "application/octet-stream")
