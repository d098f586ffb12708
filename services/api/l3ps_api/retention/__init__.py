"""The resource /v1/retention."""
