"""The resource /v1/jobs."""
