"""Limit cycles: shooting with a fixed sequence of events, orbits followed until they repeat."""
