"""What was perhaps meant by a word that is not known."""

from collections.abc import Iterable
from typing import Any

#: Digits, and the letters that they are written for.
LOOK_ALIKES = str.maketrans("01", "ol")


def did_you_mean(word: Any, names: Iterable[str]) -> str:
    """A question that names what was perhaps meant by a word, or nothing."""
    best = near(word, names)[:1]
    return f" (did you mean {best[0]!r}?)" if best else ""


def near(word: Any, names: Iterable[str]) -> list[str]:
    """The names that a word is nearly, the nearest first; what is taken for another letter at a
    glance counts as that."""
    import difflib  # late, for mistakes only

    if not isinstance(word, str):
        return []
    alike = {name: name.translate(LOOK_ALIKES) for name in names}
    told = difflib.get_close_matches(word.translate(LOOK_ALIKES), list(set(alike.values())))
    return [name for one in told for name in alike if alike[name] == one]
