"""Drive logs: types, one reader a format, safe unpacking, pre-flight validation."""
