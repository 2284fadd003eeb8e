"""What a case of a campaign gave: what does not agree, and numbers that are summed up.

A campaign is a module with

- `settings(options)`: what decides its cases, beside their numbers and the seed;
- `numbers(options)`: the numbers of its cases;
- `outcome(options, number)`: one case, compared;
- `said(counts, largest)`: how all of them are summed up, in lines;
- where that can be wrong, too, `holds(counts)`: whether it is not.
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
