"""Many runs at once: the throughput kernel, `sweep` and `basins`."""
