#!/bin/sh
# Copy what the compose stack keeps into DIR, while it runs: the catalog, then the objects. Again: only what is new.
#   sh deploy/backup.sh DIR
# The catalog first: objects never change under their key, so a later copy of them has all that an earlier catalog names.
# DIR then holds all labels and the signing secrets of webhooks; .env, with the service's own secrets, is not in it.
set -eu
. "$(dirname "$0")/copies.sh"
mkdir -p "$dir"
docker compose exec -T postgres pg_dump --username l3ps --format custom l3ps > "$dir/catalog.dump.new"
# Nothing goes from the copy before its catalog is the new one: cut short, it still has all that the old one names.
rclone copy --update --use-server-modtime "l3ps:l3ps" "$dir/objects"
mv "$dir/catalog.dump.new" "$dir/catalog.dump"
rclone sync --update --use-server-modtime "l3ps:l3ps" "$dir/objects"
echo "Copied the catalog and $(find "$dir/objects" -type f | wc -l) objects into $dir."
