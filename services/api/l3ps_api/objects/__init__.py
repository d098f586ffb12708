"""The resource /v1/objects."""
