# What backup.sh and restore.sh share: the folder, and MinIO under the name `l3ps` for rclone. Sourced, not run.
if [ $# -ne 1 ]; then
    echo "usage: sh $0 DIR" >&2
    exit 2
fi
if ! command -v rclone > /dev/null; then
    echo "rclone is not installed: see https://rclone.org/install, or on Debian: sudo apt-get install rclone" >&2
    exit 1
fi
case $1 in /*) dir=$1 ;; *) dir=$PWD/$1 ;; esac
cd "$(dirname "$0")/.."
settings=${COMPOSE_ENV_FILES:-.env}
setting() { sed -n "s/^$1=//p" "$settings"; }
unset AWS_CA_BUNDLE # of no use on loopback without TLS, and older versions of rclone stop at it
umask 077
port=$(setting MINIO_PORT)
export RCLONE_CONFIG=/dev/null RCLONE_S3_NO_CHECK_BUCKET=true
export RCLONE_CONFIG_L3PS_TYPE=s3 RCLONE_CONFIG_L3PS_PROVIDER=Minio
export RCLONE_CONFIG_L3PS_ENDPOINT="http://127.0.0.1:${port:-9000}" RCLONE_CONFIG_L3PS_ACCESS_KEY_ID=l3ps-services
RCLONE_CONFIG_L3PS_SECRET_ACCESS_KEY=$(setting L3PS_S3_SECRET)
export RCLONE_CONFIG_L3PS_SECRET_ACCESS_KEY
