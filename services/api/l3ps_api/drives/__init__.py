"""The resource /v1/drives."""
