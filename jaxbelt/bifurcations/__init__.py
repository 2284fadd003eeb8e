"""Bifurcations: points, scans along a parameter, curves, diagrams and maps."""
