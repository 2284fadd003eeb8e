"""Inverse problems: from a record to parameters (`fit`), from targets to parameters (`design`)."""
