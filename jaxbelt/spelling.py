"""What was perhaps meant by a word that is not known."""

from collections.abc import Iterable, Mapping
from typing import Any

#: Digits, and the letters that they are written for.
LOOK_ALIKES = str.maketrans("01", "ol")


def did_you_mean(word: Any, names: Iterable[str]) -> str:
    """A question that names what was perhaps meant by a word, or nothing."""
    best = near(word, names)[:1]
    return f" (did you mean {best[0]!r}?)" if best else ""


def refuse_other_names(
    of: str, names: Iterable[str], given: Iterable[str], others: Mapping[str, str] | None = None
) -> None:
    """`TypeError` where an argument has a name that is not among those taken; it tells these, and
    which was meant. of: who takes them; others: what arguments are sometimes called."""
    names = list(names)

    def told(name):
        meant = [(others or {}).get(name.lower(), ""), *near(name, names)]
        return ", ".join([*[one for one in meant if one in names][:1], f"not {name}"])

    if wrong := [name for name in given if name not in names]:
        *first, last = names or ["nothing"]
        known = f"{', '.join(first)} and {last}" if first else last
        raise TypeError(f"{of}() takes {known}: {', '.join(map(told, wrong))}")


def near(word: Any, names: Iterable[str]) -> list[str]:
    """The names that a word is nearly, the nearest first; what is taken for another letter at a
    glance counts as that."""
    import difflib  # late, for mistakes only

    if not isinstance(word, str):
        return []
    alike = {name: name.translate(LOOK_ALIKES) for name in names}
    told = difflib.get_close_matches(word.translate(LOOK_ALIKES), list(set(alike.values())))
    return [name for one in told for name in alike if alike[name] == one]
