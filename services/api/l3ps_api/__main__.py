"""``python -m l3ps_api``: the API in one uvicorn process, as the settings say."""

from __future__ import annotations

import sys
from contextlib import suppress

import uvicorn

from l3ps_api.app import create_app
from l3ps_api.server import HEAD_BYTES, Protocol, Server, most_connections
from l3ps_platform.settings import get_settings
from l3ps_platform.telemetry import configure_logging


def main() -> None:
    """Serve until SIGTERM or SIGINT."""
    settings = get_settings()
    configure_logging(settings, "api")
    app = create_app(settings)
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        server_header=False,
        # Without it anyone on this machine could give itself any address, and with it any rate limit.
        proxy_headers=bool(settings.trusted_proxies),
        forwarded_allow_ips=settings.trusted_proxies or None,
        timeout_graceful_shutdown=3,
        http=Protocol,
        h11_max_incomplete_event_size=HEAD_BYTES,
        limit_concurrency=most_connections(),  # 503 beyond it, instead of an accept that fails for everybody
    )
    server = Server(config, app.state.events)
    with suppress(KeyboardInterrupt):
        server.run()
    if not server.started:
        sys.exit(3)  # what uvicorn's own command answers with


if __name__ == "__main__":
    main()
