#!/bin/sh
# Put what deploy/backup.sh wrote into DIR in the place of all that the compose stack keeps, then start the stack.
#   sh deploy/restore.sh DIR
# Jobs that were under way at the back-up go on. Run again after a failure, it begins anew.
set -eu
. "$(dirname "$0")/copies.sh"
for part in catalog.dump objects; do
    if [ ! -e "$dir/$part" ]; then
        echo "$dir has no $part: name a folder that deploy/backup.sh wrote." >&2
        exit 1
    fi
done
docker compose down
docker compose run --rm bucket
docker compose up --detach --wait postgres minio
docker compose exec -T postgres dropdb --username l3ps --if-exists --force l3ps
docker compose exec -T postgres createdb --username l3ps l3ps
docker compose exec -T postgres pg_restore --username l3ps --dbname l3ps --exit-on-error --single-transaction < "$dir/catalog.dump"
rclone sync --checksum "$dir/objects" "l3ps:l3ps"
docker compose up --detach --wait # migrates a catalog of an earlier version
echo "Restored the catalog and $(find "$dir/objects" -type f | wc -l) objects from $dir."
