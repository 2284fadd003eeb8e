"""Motion in time: arcs between events, and `simulate`."""
