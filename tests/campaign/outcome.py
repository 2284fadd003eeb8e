"""The outcome of a case of a campaign: disagreements, and numbers to sum over cases.

A campaign is a module with `outcome(options, number)`, which runs and compares one case, and, where
they differ from those in `USUAL`, with

- `settings(options)`: options on which its cases depend, besides their numbers and the seed;
- `numbers(options)`: the numbers of its cases;
- `said(counts, largest)`: lines that sum up all cases;
- `holds(counts)`: whether the counts of all cases are right.
"""

from collections import Counter
from dataclasses import dataclass, field


@dataclass
class Outcome:
    """line: the case in a few words. wrong: disagreements. notes: what a person should look at.
    counts: added up over the cases. largest: the largest value over the cases is kept."""

    line: str = ""
    wrong: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    counts: Counter = field(default_factory=Counter)
    largest: dict[str, float] = field(default_factory=dict)

    def to_json(self):
        return {name: getattr(self, name) for name in self.__dataclass_fields__}


#: Functions of a campaign that does not define its own.
USUAL = {
    "settings": lambda options: {},
    "numbers": lambda options: range(options.runs),
    "said": lambda counts, largest: [
        f"{n} {name.replace('|', ', ')}" for name, n in sorted(counts.items())
    ],
    "holds": lambda counts: True,
}


def part(campaign, name):
    """The function of a campaign with this name, or the one in `USUAL`."""
    return getattr(campaign, name, USUAL.get(name))


def summed(outcomes):
    """The counts of all outcomes, and the largest values."""
    counts, largest = Counter(), {}
    for one in outcomes:
        counts.update(one.counts)
        for name, value in one.largest.items():
            # `max` keeps its first argument where one of them is NaN.
            is_new = name not in largest or not value <= largest[name]
            largest[name] = value if is_new else largest[name]
    return counts, largest
