"""The resources /v1/projects and /v1/me."""
