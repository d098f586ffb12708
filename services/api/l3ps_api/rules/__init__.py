"""The resource /v1/rules."""
