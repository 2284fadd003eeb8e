"""Numerical methods that know no friction."""
