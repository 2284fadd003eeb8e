"""What was perhaps meant by a word that is not known."""

from collections.abc import Iterable
from typing import Any


def did_you_mean(word: Any, names: Iterable[str]) -> str:
    """A question that names what was perhaps meant by a word, or nothing."""
    import difflib  # late, for mistakes only

    near = difflib.get_close_matches(word, list(names), 1) if isinstance(word, str) else []
    return f" (did you mean {near[0]!r}?)" if near else ""
