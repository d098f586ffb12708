"""What the scenarios stand on: servers to kill, a proxy that injects faults, a workload, a stack and checks."""
