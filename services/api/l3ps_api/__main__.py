"""``python -m l3ps_api``: the API in one uvicorn process, as the settings say."""

from __future__ import annotations

import socket
import sys
from contextlib import suppress

import uvicorn

from l3ps_api.app import create_app
from l3ps_api.events.hub import EventHub
from l3ps_platform.settings import get_settings
from l3ps_platform.telemetry import configure_logging


class Server(uvicorn.Server):
    """Tells streams that the process stops: they have no other end, and the server waits for all answers to end."""

    def __init__(self, config: uvicorn.Config, streams: EventHub) -> None:
        super().__init__(config)
        self._streams = streams

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop serving."""
        self._streams.close()
        await super().shutdown(sockets)


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
    )
    server = Server(config, app.state.events)
    with suppress(KeyboardInterrupt):
        server.run()
    if not server.started:
        sys.exit(3)  # what uvicorn's own command answers with


if __name__ == "__main__":
    main()
