"""What happens, as it happens: server-sent events of one job or of a whole project."""
