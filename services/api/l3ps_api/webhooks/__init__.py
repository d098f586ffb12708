"""Webhooks: URLs that are told of events."""
