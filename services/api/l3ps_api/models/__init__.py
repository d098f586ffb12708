"""The resource /v1/models."""
