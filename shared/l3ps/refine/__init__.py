"""3D refinement of primal labels: accumulate, ground, cluster, vote, instances."""
