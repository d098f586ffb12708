"""Make the bucket of the label engine and the key its services use; running it again changes nothing.

The root password stays with this step: the services, which read what strangers upload, get a key that reaches
this one bucket and no administration.
"""

import os

from minio import Minio, MinioAdmin
from minio.credentials import StaticProvider

ENDPOINT, BUCKET, POLICY = "minio:9000", "l3ps", "l3ps-services"

root, root_password = os.environ["MINIO_ROOT_USER"], os.environ["MINIO_ROOT_PASSWORD"]
client = Minio(endpoint=ENDPOINT, access_key=root, secret_key=root_password, secure=False)
admin = MinioAdmin(endpoint=ENDPOINT, credentials=StaticProvider(root, root_password), secure=False)

if not client.bucket_exists(BUCKET):
    client.make_bucket(BUCKET)
bucket, objects = f"arn:aws:s3:::{BUCKET}", f"arn:aws:s3:::{BUCKET}/*"
of_bucket = ["s3:GetBucketLocation", "s3:ListBucket", "s3:ListBucketMultipartUploads"]
of_objects = [
    "s3:GetObject",
    "s3:PutObject",
    "s3:DeleteObject",
    "s3:AbortMultipartUpload",
    "s3:ListMultipartUploadParts",
]
policy = {
    "Version": "2012-10-17",
    "Statement": [
        {"Effect": "Allow", "Action": of_bucket, "Resource": [bucket]},
        {"Effect": "Allow", "Action": of_objects, "Resource": [objects]},
    ],
}
admin.policy_add(POLICY, policy=policy)
admin.user_add(os.environ["L3PS_S3_KEY"], os.environ["L3PS_S3_SECRET"])
admin.policy_set(POLICY, user=os.environ["L3PS_S3_KEY"])
