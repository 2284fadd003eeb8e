"""The package against an independent engine, over many cases: `python -m tests.campaign --help`."""
