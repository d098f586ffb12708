"""The object store: one interface, two stores, chosen by a URL."""

from l3ps_platform.objects.directory import DirectoryStore
from l3ps_platform.objects.files import Incoming
from l3ps_platform.objects.interface import ObjectInfo, ObjectStore, Part, Pending
from l3ps_platform.objects.keys import attachment, check_key, content_type, segment
from l3ps_platform.objects.presign import MAX_SECONDS
from l3ps_platform.objects.signing import OBJECTS_PATH, Grant, Signer
from l3ps_platform.objects.sources import Reference, Source, SourceStore, find_source, parse_sources
from l3ps_platform.objects.stores import open_store

__all__ = [
    "MAX_SECONDS",
    "OBJECTS_PATH",
    "DirectoryStore",
    "Grant",
    "Incoming",
    "ObjectInfo",
    "ObjectStore",
    "Part",
    "Pending",
    "Reference",
    "Signer",
    "Source",
    "SourceStore",
    "attachment",
    "check_key",
    "content_type",
    "find_source",
    "open_store",
    "parse_sources",
    "segment",
]
