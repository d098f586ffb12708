#!/bin/sh
# Make a base image from Debian's packages under the name of an official one, where no image registry can be reached.
#   sudo sh deploy/offline/base-images.sh python:3.11-slim-bookworm | debian:trixie-slim
# Needs mmdebstrap. The label l3ps.stand-in tells such an image, and what is built on it, from the official one.
set -eu
case $1 in
    python:3.11-slim-bookworm) suite=bookworm packages=ca-certificates,python3,python3-pip,python3-venv,libpython3-dev ;;
    debian:trixie-slim) suite=trixie packages=ca-certificates ;;
    *) echo "No recipe for $1." >&2; exit 2 ;;
esac
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
mmdebstrap --quiet --variant=minbase --include="$packages" \
    --dpkgopt='path-exclude=/usr/share/man/*' --dpkgopt='path-exclude=/usr/share/locale/*' \
    --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-include=/usr/share/doc/*/copyright' \
    "$suite" "$work/root.tar"
docker import --change 'LABEL l3ps.stand-in=true' --change 'CMD ["python3"]' "$work/root.tar" "$1"
