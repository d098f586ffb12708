"""The HTTP API: uploads, drives, jobs, labels, models, metrics."""
