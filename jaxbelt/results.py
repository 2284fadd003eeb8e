"""Status codes. Nothing raises inside jit or vmap: every result says how it ended.

`describe(status)` gives a sentence of advice for a code.
"""

import enum

import numpy as np


class Status(enum.IntEnum):
    """How a computation ended; 0 is the ordinary end."""

    OK = 0
    STUCK_FOREVER = 1
    PSEUDO_FOCUS = 2
    TOO_MANY_SEGMENTS = 3
    TOO_MANY_STEPS = 4
    NOT_FINITE = 5


ADVICE = {
    Status.OK: "Reached the end of the time span.",
    Status.STUCK_FOREVER: (
        "The mass sticks to a belt at rest and stays there: the state holds from then on."
    ),
    Status.PSEUDO_FOCUS: (
        "The orbit converges to a pseudo-focus at a contact edge, crossing the edge ever faster; "
        "the run ends there, at rest on the edge."
    ),
    Status.TOO_MANY_SEGMENTS: (
        "The budget of segments was used up before t1; what was computed until then is given. "
        "Pass a larger max_segments or an earlier t1."
    ),
    Status.TOO_MANY_STEPS: (
        "The integrator used up its steps within one segment; what was computed until then is "
        "given. Loosen rtol and atol, or check the size of the parameters."
    ),
    Status.NOT_FINITE: (
        "A parameter, the start or the solution is not a finite number; look for NaN in the input."
    ),
}


def describe(status) -> str:
    """The sentence that goes with a status code."""
    return ADVICE[Status(int(np.asarray(status)))]


class EventKind(enum.IntEnum):
    """What happens at an event of a trajectory."""

    STICK = 1
    SLIP = 2
    CROSS = 3
    EDGE = 4
