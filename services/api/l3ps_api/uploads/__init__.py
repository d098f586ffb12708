"""The resource /v1/uploads."""
