"""What a case of a campaign gave: what does not agree, and numbers that are summed up.

A campaign is a module with `outcome(options, number)`, one case, compared; and, where it is not
what it is in `USUAL`, with

- `settings(options)`: what decides its cases, beside their numbers and the seed;
- `numbers(options)`: the numbers of its cases;
- `said(counts, largest)`: how all of them are summed up, in lines;
- `holds(counts)`: whether that is right.
"""

from collections import Counter
from dataclasses import dataclass, field


@dataclass
class Outcome:
    """line: the case in a few words. wrong: what does not agree. notes: what is to be looked into.
    counts are added up over the cases, and of `largest` the largest values are kept."""

    line: str = ""
    wrong: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    counts: Counter = field(default_factory=Counter)
    largest: dict[str, float] = field(default_factory=dict)

    def to_json(self):
        return {name: getattr(self, name) for name in self.__dataclass_fields__}


#: What of a campaign need not be written.
USUAL = {
    "settings": lambda options: {},
    "numbers": lambda options: range(options.runs),
    "said": lambda counts, largest: [
        f"{n} {name.replace('|', ', ')}" for name, n in sorted(counts.items())
    ],
    "holds": lambda counts: True,
}


def part(campaign, name):
    """A function of a campaign by its name."""
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
