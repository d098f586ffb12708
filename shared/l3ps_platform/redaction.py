"""Secrets left out of every line that is logged, whoever wrote it: a library, a traceback, a client's own words."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from urllib.parse import quote, unquote, urlsplit

from l3ps_platform.objects.sources import parse_sources
from l3ps_platform.settings import S3Location, Settings

SHORTEST = 6
"""Characters; anything shorter would be found in ordinary words."""
_GONE = "…"
_PATTERNS = (
    re.compile(r"(l3ps_(?:key_)?[0-9a-z]{16,40}_)[A-Za-z0-9_-]{40,}"),  # an API key: its id stays
    re.compile(r"((?i:bearer|basic) +)[A-Za-z0-9._~+/=-]{6,}"),
    re.compile(r"((?i:x-amz-signature|signature|x-amz-credential|x-amz-security-token)=)[^&\s\"'\\]+"),
    re.compile(r"(whsec_)[A-Za-z0-9+/=_-]{8,}"),  # a webhook's
    re.compile(r"(\w+://[^\s:/@\"']*:)[^\s/@\"']+(?=@)"),  # a URL's password
)


class Redactor:
    """Takes secrets out of text.

    Args:
        settings: whose secrets; what only looks like a secret goes too.
    """

    def __init__(self, settings: Settings) -> None:
        found = {form for secret in _secrets(settings) for form in _forms(secret) if len(form) >= SHORTEST}
        longest_first = sorted(found, key=len, reverse=True)
        self._known = re.compile("|".join(map(re.escape, longest_first))) if found else None

    def __call__(self, text: str) -> str:
        """The text without them."""
        if self._known is not None:
            text = self._known.sub(_GONE, text)
        for pattern in _PATTERNS:
            text = pattern.sub(rf"\1{_GONE}", text)
        return text


def _secrets(settings: Settings) -> Iterator[str]:
    if settings.token is not None:
        yield settings.token.get_secret_value()
    for url in (settings.database_url, settings.redis_url):
        yield unquote(urlsplit(url).password or "")
    if settings.objects_url.startswith("s3://"):
        yield S3Location.parse(settings.objects_url).secret_key.get_secret_value()
    for source in parse_sources(settings.sources.get_secret_value()):
        yield source.location.secret_key.get_secret_value()


def _forms(secret: str) -> set[str]:
    """A secret as it may stand in a line: as it is, in a URL, in JSON."""
    return {secret, quote(secret, safe=""), json.dumps(secret)[1:-1], json.dumps(secret, ensure_ascii=False)[1:-1]}
