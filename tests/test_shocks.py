"""Minimal fatal shocks: closed forms, SciPy, the independent engine, differences.

The campaign is `python -m tests.campaign shocks`; what it found is in docs/checked.md.
"""
