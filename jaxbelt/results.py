"""What all results share: status codes, kinds of events, and drawing.

Nothing raises inside jit or vmap: every result has a status, and `describe(status)` returns a
sentence of advice for it.
"""

import enum
import operator
from collections.abc import Callable
from typing import Any


class Status(enum.IntEnum):
    """How a computation ended; 0 is the ordinary end. `describe` returns advice for each."""

    OK = 0  #: computed to the end
    # Runs: `simulate`, `sweep`.
    STUCK_FOREVER = 1  #: the mass sticks to a belt at rest for good
    PSEUDO_FOCUS = 2  #: the orbit converges to a pseudo-focus at a contact edge
    TOO_MANY_SEGMENTS = 3  #: the budget of arcs or events was used up
    TOO_MANY_STEPS = 4  #: the integrator used up its steps within one arc
    # All computations.
    NOT_FINITE = 5  #: a number is not finite, or a parameter is impossible
    # Cycles: `find_cycle`, `unstable_cycle`.
    EQUILIBRIUM = 6  #: the orbit comes to rest at an equilibrium
    NOT_SETTLED = 7  #: no loop repeated within the budget
    TOO_MANY_ARCS = 8  #: a loop has more arcs than there is room for
    # All that Newton's method solves.
    NO_CONVERGENCE = 9  #: Newton's method did not converge
    NOT_ADMISSIBLE = 10  #: the solution of the equations leaves its modes
    NO_UNSTABLE_CYCLE = 11  #: there is no unstable cycle
    # Bifurcation points: `refine`, `scan`.
    NOT_TOUCHED = 12  #: nothing comes near that boundary or edge
    OTHER_KIND = 13  #: the point nearby is of another kind
    NO_FIXED_POINT = 14  #: there is no fixed point in a smooth field
    UNEXPLAINED = 15  #: something changes here, and no condition explains it
    # Records: `fit`.
    NOT_IDENTIFIED = 16  #: the record does not determine all parameters
    MISFIT = 17  #: the best fit leaves more than noise
    # Targets: `design`.
    UNREACHABLE = 18  #: the targets were not reached within the bounds
    # Bifurcation points.
    NO_FOLD = 19  #: no two cycles meet nearby
    # Portraits, and shocks in them.
    INCOMPLETE = 20  #: something may be missing
    # Cycles, and runs of a sweep.
    NEUTRAL = 21  #: the orbit is one of a continuum of closed orbits
    # Bifurcation points.
    DEGENERATE = 22  #: the condition holds all along the parameter


ADVICE = {
    Status.OK: "Computed to the end.",
    Status.STUCK_FOREVER: (
        "The mass sticks to a belt at rest and stays there: the state holds from then on."
    ),
    Status.PSEUDO_FOCUS: (
        "The orbit converges to a pseudo-focus at a contact edge, crossing the edge ever faster; "
        "the run ends there, at rest on the edge."
    ),
    Status.TOO_MANY_SEGMENTS: (
        "The budget of segments was used up before t1; what was computed until then is given. "
        "Pass a larger max_segments (in a batch or a derivative max_events, too) or an earlier t1."
    ),
    Status.TOO_MANY_STEPS: (
        "The integrator used up its steps within one segment; what was computed until then is "
        "given. Loosen rtol and atol, or check the size of the parameters, and that a law of your "
        "own is finite and smooth at all speeds that are met."
    ),
    Status.NOT_FINITE: (
        "A parameter, the start or the solution is not a finite number, or a parameter is "
        "impossible; look in the input for NaN, for a negative load or a kinetic coefficient above "
        "the static one, and, where damping is negative, for motions that grow beyond all bounds."
    ),
    Status.EQUILIBRIUM: (
        "The orbit comes to rest at an equilibrium: this start leads to no cycle. Start further "
        "out, or look at equilibria(osc)."
    ),
    Status.NOT_SETTLED: (
        "No loop of the orbit repeated within the budget of arcs: it approaches its attractor very "
        "slowly, or, where damping is negative, grows beyond all bounds. Start nearer to the "
        "cycle, or move away from the bifurcation point. With forcing it may be chaotic or "
        "quasi-periodic (see jb.lyapunov), repeat after more than the 16 periods of jb.find_cycle "
        "(labels of jb.sweep know longer ones), or grow at resonance where nothing damps it."
    ),
    Status.TOO_MANY_ARCS: "A loop has more arcs than there is room for: pass a larger max_arcs.",
    Status.NO_CONVERGENCE: (
        "Newton's method did not converge from this guess; there may be no such solution near it, "
        "or none that this side of it leads to: try a guess on the other side. Every bifurcation "
        "point in an interval is found by jb.scan with a span around it; with forcing, those on a "
        "branch by jb.bifurcation_diagram. A friction law of your own has to be smooth; "
        "jb.Tabulated makes one of a table."
    ),
    Status.NOT_ADMISSIBLE: (
        "The solution of the equations leaves its modes (an arc passes a boundary, or ends before "
        "it begins), so the oscillator does not move along it."
    ),
    Status.NO_UNSTABLE_CYCLE: (
        "There is no unstable cycle between a stable equilibrium and the motion outside of it: no "
        "equilibrium is stable, or everything comes to rest there, or the cycle passes the "
        "boundary of a belt; jb.portrait finds those that do."
    ),
    Status.NOT_TOUCHED: (
        "Nothing comes near the boundary or an edge of that belt here, so no such point is near, "
        "or the cycle ends in it and exists on its other side only (or, of a condition of your "
        "own, its equation has a value in no attracting cycle); try another belt or another value "
        "of the parameter, or jb.scan with a span around it, with forcing jb.bifurcation_diagram."
    ),
    Status.OTHER_KIND: (
        "The cycle does touch the boundary at a point near here, but the point is of another kind: "
        "a nonsmooth fold ends the cycle, at a grazing point it goes on to both sides. jb.scan "
        "with a span around it finds every point there."
    ),
    Status.NO_FOLD: (
        "No loop of the orbits around the equilibrium is extremal in its growth, or none that is "
        "closes nearby: no two cycles meet near here. jb.scan with a span finds where they do."
    ),
    Status.NO_FIXED_POINT: (
        "There is no fixed point in a smooth field whose trace could vanish. Where there is one "
        "elsewhere, jb.scan with a span finds its points."
    ),
    Status.INCOMPLETE: (
        "Not everything is known: in the gaps there may be cycles (a continuum of closed orbits, "
        "cycles about to merge, orbits that settle too slowly), or a separatrix is missing, of a "
        "node on a contact edge, or is unsettled, or was not followed far enough for the shock "
        "asked for; or, of a point, a search was left before it had looked into the interval "
        "around it. Move away from the bifurcation point, or ask of a shorter span."
    ),
    Status.NEUTRAL: (
        "The orbit closes, and so do those beside it, as around a centre: no cycle that attracts, "
        "but one of a continuum, and which one depends on the start; or, with forcing, the mass "
        "sticks for ever wherever it came to stick. simulate follows it."
    ),
    Status.DEGENERATE: (
        "The condition holds here and beside it, all along the parameter as far as numbers show: "
        "there is no one value at which it does. Vary another parameter, or shift one that makes "
        "it hold, such as the edge that lies on an equilibrium. jb.scan finds what else happens."
    ),
    Status.UNEXPLAINED: (
        "What the oscillator does changes here, and no condition known to the search explains how. "
        "Simulate on both sides."
    ),
    Status.NOT_IDENTIFIED: (
        "The record does not determine all of the parameters: those with a standard error that is "
        "infinite, or larger than they are, may have quite other values, alone or together with "
        "another, with which the record is fitted nearly as well. "
        "Fit fewer of them, tie some, or measure a motion that feels them: one that touches that "
        "belt, or slips at other speeds."
    ),
    Status.MISFIT: (
        "The best fit leaves more than noise: more than was given, or, where it was estimated, "
        "residuals with a shape. Where their autocorrelation is about 0 it found the motion, and "
        "the noise is larger than was said: by the root of the reduced chi^2. Else the model is "
        "not that of the record (a number that is kept is wrong, the law, or the units: all is "
        "dimensionless, of a machine machine.tau(t) and X / machine.units.length), or a better fit "
        "was not found: look at plot(), free another parameter, try a nearer guess or more starts."
    ),
    Status.UNREACHABLE: (
        "No choice of the parameters within their bounds reaches the targets along this way; what "
        "comes nearest is given. Widen the bounds, free more parameters, or start elsewhere."
    ),
}


def describe(status) -> str:
    """Returns a sentence of advice for a status code.

    Args:
        status: A `Status`, or its number.

    Returns:
        What happened, and what to do about it.

    Raises:
        ValueError: If there is no such status.
    """
    try:
        return ADVICE[Status(operator.index(status))]
    except (TypeError, ValueError):
        raise ValueError(f"status must be a Status, or its number, got {status!r}") from None


class EventKind(enum.IntEnum):
    """What happens at an event of a trajectory."""

    STICK = 1  #: the mass begins to stick to the belt
    SLIP = 2  #: slip onset: the belt no longer holds the mass
    CROSS = 3  #: the relative velocity changes its sign, and the mass goes on slipping
    EDGE = 4  #: the mass passes an end of the belt's contact interval


#: The function that draws results, set by `draw_with`. It is defined in `plotting`, which imports
#: everything else, so `jaxbelt/__init__.py` passes it in.
_drawing: Callable[..., Any] | None = None


def draw_with(drawing: Callable[..., Any]) -> None:
    """Registers `drawing(result, ax, **options)` as the function that draws results."""
    global _drawing
    _drawing = drawing


def draw(result: Any, ax: Any, **options: Any) -> Any:
    """Draws a result; the method `plot` of every result calls this."""
    assert _drawing is not None, "jaxbelt/__init__.py registers it"
    return _drawing(result, ax, **options)
