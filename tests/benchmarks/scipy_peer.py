"""The same questions, asked of a script with SciPy as one would write it for two belts without
edges: `python tests/benchmarks/scipy_peer.py QUESTION` prints the answer and the seconds until it.

The velocities of the belts are those of class (b); orbits are followed by `solve_ivp` with events.
"""

import json
import sys
import time

BEGAN = time.perf_counter()

import numpy as np  # noqa: E402
from scipy.integrate import solve_ivp  # noqa: E402

DAMPING = 0.5
PRECISE = dict(method="DOP853", rtol=1e-10, atol=1e-12)


def mu(r):
    return 0.6 + 0.4 / (1 + 10 * r)


def friction(nus, signs, x2):
    """The force of the belts that slip, each in its sense; 0 stands for none."""
    return sum(s * mu(abs(nu - x2)) for nu, s in zip(nus, signs, strict=True) if s)


def simulate(nus, y0, t1):
    """Events (t, belt, whether a stick phase ends there, x1, x2), and the state at t1."""
    t, y, events = 0.0, np.array(y0, float), []
    signs = [int(np.sign(nu - y[1])) for nu in nus]
    while t < t1 and len(events) < 1000:
        slips = [i for i in range(2) if signs[i]]

        def meets(i):
            def gap(_, state):
                return signs[i] * (nus[i] - state[1])

            gap.terminal, gap.direction = True, -1
            return gap

        def field(_, state):
            x1, x2 = state
            return x2, -x1 - DAMPING * x2 + friction(nus, signs, x2)

        way = solve_ivp(field, (t, t1), y, events=[meets(i) for i in slips], **PRECISE)
        t, y = float(way.t[-1]), way.y[:, -1]
        if way.status != 1:
            break
        belt = next(i for i, found in zip(slips, way.t_events, strict=True) if found.size)
        others = [0 if i == belt else sign for i, sign in enumerate(signs)]
        velocity = y[1] = nus[belt]
        rest = friction(nus, others, velocity) - DAMPING * velocity
        held = y[0] - rest
        if abs(held) >= 1:
            signs[belt] = int(np.sign(held))
            events.append((t, belt, False, *y))
            continue
        onset = rest + np.sign(velocity)
        wait = (onset - y[0]) / velocity if velocity else np.inf
        if t + wait >= t1:
            return events, np.array([y[0] + velocity * (t1 - t), velocity])
        t, y, signs[belt] = t + wait, np.array([onset, velocity]), int(np.sign(velocity))
        events.append((t, belt, True, *y))
    return events, y


def attractor(nus, y0=(3.0, 0.0), t1=100.0):
    """The period of the cycle and the belts that it sticks to; without sticking, no period."""
    events, _ = simulate(nus, y0, t1)
    for n in range(1, len(events) // 2):
        one, other = events[-1], events[-1 - n]
        if one[1:3] == other[1:3] and np.hypot(one[3] - other[3], one[4] - other[4]) < 1e-8:
            return one[0] - other[0], {e[1] for e in events[-n:] if e[2]}
    return np.nan, set()


def refine(low, high):
    """Where the cycle ceases to stick to belt 1, by bisection to 1e-10."""

    def sticks(value):
        return 1 in attractor((value, 0.35))[1]

    at_low = sticks(low)
    while high - low > 1e-10:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if sticks(middle) == at_low else (low, middle)
    return 0.5 * (low + high)


def labels(side):
    # Belts with the same velocity would need a case of their own.
    first, second = np.linspace(-0.7, 0.7, side), np.linspace(-0.69, 0.71, side)
    return [sorted(attractor((a, b))[1]) for a in first for b in second]


QUESTIONS = {
    "simulate": lambda: simulate((0.45, 0.35), (3.0, 0.0), 100.0)[1].tolist(),
    "find_cycle": lambda: attractor((0.45, 0.35))[0],
    "refine": lambda: refine(0.45, 0.6),
    "sweep": lambda: labels(8),  # 64 of 4,096 runs
}

if __name__ == "__main__":
    imported = time.perf_counter()
    answer = QUESTIONS[sys.argv[1]]()
    seconds = time.perf_counter() - imported
    print(json.dumps(dict(imported=imported - BEGAN, seconds=seconds, answer=answer)))
