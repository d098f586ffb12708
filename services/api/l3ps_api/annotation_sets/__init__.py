"""The resource /v1/annotations."""
