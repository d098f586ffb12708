#!/bin/sh
# Install a Docker engine with compose v2 and buildx on a bare Debian machine, from Debian's packages alone.
#   sudo sh deploy/offline/install-engine.sh
# Debian 13 packages all of it. Debian 12 has the engine, but no compose v2 and no buildx: those two are static command
# line plugins, so they are taken out of Debian 13's packages. `docker` itself and its services are left as they are.
set -eu
apt-get update
apt-get install --yes --no-install-recommends docker.io iptables mmdebstrap rclone
if docker compose version >/dev/null 2>&1 && docker buildx version >/dev/null 2>&1; then
    exit 0
fi
if [ -n "$(apt-cache search --names-only '^docker-buildx$')" ]; then
    apt-get install --yes --no-install-recommends docker-compose docker-buildx
    exit 0
fi

mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' 'Label: Debian' | head -n 1)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
mkdir -p "$work/lists/partial" "$work/cache/archives/partial"
echo "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] $mirror trixie main" > "$work/sources.list"
# Lists and cache of its own: the machine's package manager never hears of the other release.
apt_trixie() {
    apt-get -o Dir::Etc::sourcelist="$work/sources.list" -o Dir::Etc::sourceparts=- \
        -o Dir::State::lists="$work/lists" -o Dir::Cache="$work/cache" -o APT::Sandbox::User=root "$@"
}
apt_trixie update
(cd "$work" && apt_trixie download docker-compose docker-buildx)
for package in "$work"/*.deb; do
    dpkg-deb --extract "$package" "$work/unpacked"
done
install -D -t /usr/local/lib/docker/cli-plugins "$work"/unpacked/usr/libexec/docker/cli-plugins/*
docker compose version
docker buildx version
