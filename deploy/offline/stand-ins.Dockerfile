# Redis, PostgreSQL and Prometheus from Debian's packages, for machines that reach no image registry.
# They honour the part of the official images' contract that docker-compose.yml relies on (users, folders, environment),
# so that the compose file itself is tried unchanged. Never for production: another minor version, no entry-point scripts.
FROM debian:trixie-slim AS redis
RUN groupadd --gid 999 redis && useradd --uid 999 --gid 999 --no-create-home redis \
    && apt-get update && apt-get install --yes --no-install-recommends redis-server && rm -rf /var/lib/apt/lists/* \
    && install -d -o 999 -g 999 /data
LABEL l3ps.stand-in=true
WORKDIR /data
VOLUME /data
EXPOSE 6379
CMD ["redis-server"]

FROM debian:trixie-slim AS postgres
RUN groupadd --gid 999 postgres && useradd --uid 999 --gid 999 --no-create-home --home-dir /var/lib/postgresql postgres \
    && apt-get update && apt-get install --yes --no-install-recommends postgresql-17 && rm -rf /var/lib/apt/lists/* /var/lib/postgresql/17 \
    && install -d -o 999 -g 999 /var/lib/postgresql/data /var/run/postgresql
COPY postgres-entrypoint.sh /usr/local/bin/docker-entrypoint.sh
LABEL l3ps.stand-in=true
ENV PGDATA=/var/lib/postgresql/data PATH=/usr/lib/postgresql/17/bin:$PATH
VOLUME /var/lib/postgresql/data
EXPOSE 5432
STOPSIGNAL SIGINT
ENTRYPOINT ["sh", "/usr/local/bin/docker-entrypoint.sh"]
CMD ["postgres"]

FROM debian:trixie-slim AS prometheus
RUN apt-get update && apt-get install --yes --no-install-recommends prometheus && rm -rf /var/lib/apt/lists/* \
    && install -d -o 65534 -g 65534 /prometheus
LABEL l3ps.stand-in=true
VOLUME /prometheus
EXPOSE 9090
USER 65534:65534
ENTRYPOINT ["prometheus"]
CMD ["--config.file=/etc/prometheus/prometheus.yml", "--storage.tsdb.path=/prometheus"]
