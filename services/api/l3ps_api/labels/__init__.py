"""The resource /v1/jobs/{id}/labels."""
