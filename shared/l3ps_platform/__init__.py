"""Settings, catalog, object store, queue and telemetry shared by the services."""
