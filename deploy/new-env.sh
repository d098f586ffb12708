#!/bin/sh
# Write .env from .env.example, every empty setting filled with a random secret. Never overwrites one.
#   sh deploy/new-env.sh [FILE]
set -eu
root=$(cd "$(dirname "$0")/.." && pwd)
target=${1:-$root/.env}
if [ -e "$target" ]; then
    echo "$target exists already; move it away to make new secrets (the volumes keep the old ones)." >&2
    exit 1
fi
umask 077
while IFS= read -r line; do
    case $line in
        [A-Z]*=) printf '%s%s\n' "$line" "$(od -An -N20 -tx1 /dev/urandom | tr -d ' \n')" ;;
        *) printf '%s\n' "$line" ;;
    esac
done < "$root/.env.example" > "$target"
echo "Wrote $target."
