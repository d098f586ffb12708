"""The resource /v1/trainings."""
