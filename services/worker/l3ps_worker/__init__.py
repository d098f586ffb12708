"""Celery workers: load, call l3ps, store, record."""
