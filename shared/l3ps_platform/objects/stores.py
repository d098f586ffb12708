"""Which store a URL names."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import unquote, urlsplit

from l3ps_platform.objects.directory import DirectoryStore
from l3ps_platform.objects.interface import ObjectStore
from l3ps_platform.objects.s3 import S3Store
from l3ps_platform.settings import S3Location, Settings


def open_store(settings: Settings) -> ObjectStore:
    """The store the settings name; does not touch it (see ``ensure``)."""
    url = settings.store_url
    if url.startswith("s3://"):
        return S3Store(S3Location.parse(url), settings.objects_public_url)
    return DirectoryStore(Path(unquote(urlsplit(url).path)), settings.api_url)
