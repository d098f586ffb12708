"""What buckets tell: /v1/notifications."""
