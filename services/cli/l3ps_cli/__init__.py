"""The l3ps command: label, evaluate, simulate, bench, up, submit, download."""
