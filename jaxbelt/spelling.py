"""Suggestions for a word that is not known."""

from collections.abc import Iterable, Mapping
from typing import Any

#: Digits, and the letters that they are mistaken for.
LOOK_ALIKES = str.maketrans("01", "ol")
#: Names of arguments in other packages, and those of this one.
NAMES_ELSEWHERE = {
    **dict.fromkeys(("start", "initial", "state", "state0", "x0", "y", "init"), "y0"),
    **dict.fromkeys(("t_end", "tend", "tmax", "t_max", "t_final", "duration"), "t1"),
    **dict.fromkeys(("t", "times", "t_eval", "saveat"), "ts"),
    **dict.fromkeys(("tol", "tolerance"), "rtol"),
    **dict.fromkeys(("parameter", "param"), "where"),
    **dict.fromkeys(("range", "interval", "limits"), "span"),
    **dict.fromkeys(("grid", "params", "parameters", "values"), "axes"),
    **dict.fromkeys(("observable", "output"), "observe"),
}


def did_you_mean(word: Any, names: Iterable[str]) -> str:
    """A question that suggests a word, or ""."""
    best = near(word, names)[:1]
    return f" (did you mean {best[0]!r}?)" if best else ""


def refuse_other_names(
    of: str, names: Iterable[str], given: Iterable[str], others: Mapping[str, str] = NAMES_ELSEWHERE
) -> None:
    """Raises a `TypeError` for an argument with an unknown name.

    The message lists the known names and suggests one.

    Args:
        of: Name of the function.
        names: Names that it takes.
        given: Names that came.
        others: Names of arguments elsewhere, and the ones to suggest.
    """
    names = list(names)

    def described(name):
        meant = [others.get(name.lower(), ""), *near(name, names)]
        return ", ".join([*[one for one in meant if one in names][:1], f"not {name}"])

    if wrong := [name for name in given if name not in names]:
        *first, last = names or ["nothing"]
        known = f"{', '.join(first)} and {last}" if first else last
        raise TypeError(f"{of}() takes {known}: {', '.join(map(described, wrong))}")


def near(word: Any, names: Iterable[str]) -> list[str]:
    """Names that are similar to a word, the nearest first.

    Look-alike characters count as equal, and so do capitals and small letters.
    """
    import difflib  # late, for mistakes only

    if not isinstance(word, str):
        return []
    alike = {name: name.lower().translate(LOOK_ALIKES) for name in names}
    like = word.lower().translate(LOOK_ALIKES)
    similar = difflib.get_close_matches(like, list(set(alike.values())))
    return [name for one in similar for name in alike if alike[name] == one]
