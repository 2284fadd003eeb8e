"""Sweeps beside other programs: `pytest tests/benchmarks/test_sweep.py --benchmark-only -s`.

Workload W1: class (b), start (1.5, 0), the state at T = 100, tolerance 1e-8, for the n x n points
nu0 = -0.7 + 1.4 (i + 0.5)/n, nu1 = -0.6987 + 1.4 (j + 0.5)/n. Nothing here asserts a time.
"""

import functools
import shutil
import subprocess
import time
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxbelt as jb
from jaxbelt.sweeps import threads as sweep_threads
from tests.benchmarks.timing import least

SPAN, TOLERANCE = 100.0, 1e-8


def w1(n):
    i = (np.arange(n) + 0.5) / n
    return {"nu0": -0.7 + 1.4 * i, "nu1": -0.6987 + 1.4 * i}


def swept(n, **options):
    options = dict(y0=(1.5, 0.0), t1=SPAN, rtol=TOLERANCE, atol=TOLERANCE) | options
    return jb.sweep(jb.presets.class_b, w1(n), **options)


def built(source, folder):
    """The C++ program of that name beside this file, built for this processor, or None."""
    compiler = shutil.which("g++")
    if compiler is None:
        return None
    program = folder / Path(source).stem
    build = [compiler, "-std=c++17", "-O3", "-march=native", "-o", str(program)]
    build.append(str(Path(__file__).with_name(source)))
    return program if subprocess.run(build, capture_output=True).returncode == 0 else None


def printed(program, *arguments):
    """The numbers that a program prints."""
    run = subprocess.run([program, *map(str, arguments)], capture_output=True, check=True)
    return tuple(map(float, run.stdout.split()))


def fastest(program, n):
    """Seconds and the sum of |x1(T)|."""
    return min(printed(program, n, SPAN, TOLERANCE) for _ in range(3))


def vmapped(n):
    ts = jnp.array([SPAN])

    @jax.jit
    @jax.vmap
    def end(nu0, nu1):
        osc = jb.presets.class_b(nu0, nu1)
        tolerances = dict(rtol=TOLERANCE, atol=TOLERANCE)
        return jb.simulate(osc, (1.5, 0.0), SPAN, ts=ts, **tolerances).ys[0, 0]

    grid = [jnp.asarray(part.ravel()) for part in np.meshgrid(*w1(n).values(), indexing="ij")]
    return lambda: np.asarray(jax.block_until_ready(end(*grid)))


def scipy_runs(n):
    """No events: the switch model's field with a narrow band, as one would write it first."""

    def end(nu0, nu1):
        def field(t, y):
            x1, x2 = y
            force = -x1 - 0.5 * x2
            for nu, other in ((nu0, nu1), (nu1, nu0)):
                r, s = nu - x2, other - x2
                needed = -x1 - 0.5 * x2 + np.sign(s) * (0.4 / (1 + 10 * abs(s)) + 0.6)
                if abs(r) <= 1e-6 and abs(needed) < 1:
                    return nu, r
                force += np.sign(r) * (0.4 / (1 + 10 * abs(r)) + 0.6)
            return x2, force

        options = dict(rtol=TOLERANCE, atol=TOLERANCE)
        return solve_ivp(field, (0, SPAN), (1.5, 0.0), "DOP853", **options).y[0, -1]

    axes = w1(n)
    return lambda: np.array([end(a, b) for a in axes["nu0"] for b in axes["nu1"]])


def numba_runs(n):
    """An event loop as one writes it for numba: Dormand and Prince's 5(4) pair, a step that passes
    a boundary made again by the secant rule until it ends there; or None without numba."""
    try:
        import numba
    except ImportError:
        return None
    tableau = diffrax.Dopri5.tableau
    weights = np.zeros((7, 7))
    for i, row in enumerate(tableau.a_lower):
        weights[i + 1, : row.size] = row
    errors = tableau.b_error

    @numba.njit(fastmath=False)
    def acceleration(nu, s, x1, x2):
        force = -x1 - 0.5 * x2
        for i in range(2):
            force += s[i] * (0.4 / (1 + 10 * max(s[i] * (nu[i] - x2), -0.05)) + 0.6)
        return force

    @numba.njit
    def step(nu, s, x1, x2, h, v, a):
        """The state after a step, and its error over the tolerance; v, a: work."""
        for i in range(7):
            p, q = x1, x2
            for j in range(i):
                p += h * weights[i, j] * v[j]
                q += h * weights[i, j] * a[j]
            v[i], a[i] = q, acceleration(nu, s, p, q)
        e1, e2 = 0.0, 0.0
        for j in range(7):
            e1 += h * errors[j] * v[j]
            e2 += h * errors[j] * a[j]
        scale1 = TOLERANCE * (1 + max(abs(x1), abs(p)))
        scale2 = TOLERANCE * (1 + max(abs(x2), abs(q)))
        return p, q, max(abs(e1) / scale1, abs(e2) / scale2)

    @numba.njit
    def passed(nu, s, x2):
        """The boundary that x2 lies farthest beyond, and how far."""
        gaps = s[0] * (nu[0] - x2), s[1] * (nu[1] - x2)
        return (0, gaps[0]) if gaps[0] < gaps[1] else (1, gaps[1])

    @numba.njit
    def run(nu):
        x1, x2, t, h = 1.5, 0.0, 0.0, 0.05
        s = np.sign(nu - x2)
        v, a = np.zeros(7), np.zeros(7)
        while t < SPAN:
            h = min(h, SPAN - t)
            p, q, error = step(nu, s, x1, x2, h, v, a)
            proposed = h * min(5.0, max(0.2, 0.9 * max(error, 1e-10) ** -0.2))
            if error > 1:
                h = proposed
                continue
            k, gap = passed(nu, s, q)
            if gap >= -1e-12:
                t, x1, x2, h = t + h, p, q, proposed
                continue
            near, far, g_near, g_far = 0.0, h, max(s[k] * (nu[k] - x2), 1e-12), gap
            while far - near > 1e-13 and abs(gap) > 1e-13:
                middle = near + (far - near) * g_near / (g_near - g_far)
                p, q, error = step(nu, s, x1, x2, middle, v, a)
                gap = s[k] * (nu[k] - q)
                # Illinois: halve the value at the end that stays.
                if gap > 0:
                    near, g_near, g_far = middle, gap, 0.5 * g_far
                else:
                    far, g_far, g_near = middle, gap, 0.5 * g_near
                h = middle
            t, x1, x2, h = t + h, p, nu[k], 0.05
            other = 1 - k
            side = np.sign(nu[other] - nu[k])
            force = side * (0.4 / (1 + 10 * abs(nu[other] - nu[k])) + 0.6)
            needed = -x1 - 0.5 * x2 + force
            if abs(needed) < 1:
                sign = np.sign(nu[k])
                duration = min((needed + sign) / nu[k], SPAN - t)
                t, x1 = t + duration, x1 + nu[k] * duration
                s[k], s[other] = sign, side
            else:
                s[k] = -s[k]
        return x1

    grid = np.stack([part.ravel() for part in np.meshgrid(*w1(n).values(), indexing="ij")], axis=1)
    loop = numba.njit(lambda grid: np.array([run(row) for row in grid]))
    return lambda: loop(grid)


def heyoka_runs(n):
    """Heyoka's adaptive Taylor integrator, in batches as wide as a register (32 and 64 are slower),
    with terminal events that callbacks answer; or None without heyoka."""
    try:
        import heyoka as hy
    except ImportError:
        return None
    x1, x2 = hy.make_vars("x1", "x2")
    # Rows of parameters: velocities, signs, stuck (0 or 1), x1 and direction of slip onset.
    nus, signs = (hy.par[0], hy.par[1]), (hy.par[2], hy.par[3])
    stuck, onset, direction = hy.par[4], hy.par[5], hy.par[6]
    force = -x1 - 0.5 * x2
    for nu, sign in zip(nus, signs, strict=True):
        force += sign * (0.4 / (1 + 10 * sign * (nu - x2)) + 0.6)

    def arrives(k):
        """At the boundary of belt k: stick or cross."""

        def callback(integrator, _, lane):
            state, par = integrator.state, integrator.pars
            nu, other = par[k, lane], par[1 - k, lane]
            side, sign = np.sign(other - nu), np.sign(nu)
            rest = -0.5 * nu + side * (0.4 / (1 + 10 * abs(other - nu)) + 0.6)
            state[1, lane] = nu
            if abs(rest - state[0, lane]) < 1:
                par[2 + k, lane], par[3 - k, lane] = sign, side
                par[4:, lane] = 1.0, rest + sign, sign
            else:
                par[2 + k, lane] *= -1
            return True

        return callback

    def slips(integrator, _, lane):
        # A hair beside the boundary, to which slip is tangent: else it is found again at once.
        par = integrator.pars
        integrator.state[:, lane] = par[5, lane], integrator.state[1, lane] - 1e-10 * par[6, lane]
        par[4, lane] = 0.0
        return True

    slides = [(1 - stuck) * s * (nu - x2) + stuck for nu, s in zip(nus, signs, strict=True)]
    falling = dict(direction=hy.event_direction.negative)
    events = [
        *(hy.t_event_batch(slides[k], callback=arrives(k), **falling) for k in (0, 1)),
        hy.t_event_batch(stuck * direction * (onset - x1) + (1 - stuck), callback=slips, **falling),
    ]
    lanes = hy.recommended_simd_size()
    integrator = hy.taylor_adaptive_batch(
        [(x1, x2), (x2, (1 - stuck) * force)],
        state=np.zeros((2, lanes)),
        pars=np.zeros((7, lanes)),
        tol=TOLERANCE,
        t_events=events,
    )
    grid = np.stack([part.ravel() for part in np.meshgrid(*w1(n).values(), indexing="ij")])

    def call():
        ends = []
        for first in range(0, n * n, lanes):
            velocities = grid[:, first : first + lanes]
            integrator.set_time(np.zeros(lanes))
            integrator.reset_cooldowns()
            integrator.state[:] = [[1.5], [0.0]]
            integrator.pars[:] = [*velocities, *np.sign(velocities), *np.zeros((3, lanes))]
            # Without a bound the step of a lane that sticks is infinite.
            integrator.propagate_until(np.full(lanes, SPAN), max_delta_t=np.full(lanes, 4.0))
            ends.append(integrator.state[0].copy())
        return np.concatenate(ends)

    return call


def test_w1_side_by_side(benchmark, tmp_path, monkeypatch):
    """A table: runs per second of one core, the ratio to Boost.odeint, and the sum of |x1(T)|."""
    monkeypatch.setattr(sweep_threads, "workers", lambda: 1)
    n = 256
    rows = []
    peer = built("sweep_peer.cpp", tmp_path)
    if peer is None:
        print("Boost.odeint: skipped, no g++ or no Boost headers")
    else:
        rows.append(("Boost.odeint (C++)", n, *fastest(peer, n)))
    limit = built("sweep_limit.cpp", tmp_path)
    if limit is None:
        print("by hand: skipped, no g++ that compiles it")
    else:
        bits = int(*printed(limit))
        if bits < 512:
            print(f"by hand: no AVX-512, so this is the limit of registers of {bits} bits")
        rows.append((f"by hand, {bits}-bit SIMD (C++)", n, *fastest(limit, n)))
    _, seconds, dataset = least(lambda: swept(n))
    rows.append(("sweep", n, seconds, float(np.abs(dataset.x1_end).sum())))
    for name, size, runs, repeat in (
        ("numba event loop", 64, numba_runs, 3),
        ("heyoka (Taylor, LLVM)", 32, heyoka_runs, 3),
        ("vmap of simulate", 16, vmapped, 3),
        ("SciPy, no events", 3, scipy_runs, 1),
    ):
        call = runs(size)
        if call is None:
            print(f"{name}: skipped, not installed")
            continue
        _, seconds, x1 = least(call, repeat)
        rows.append((name, size, seconds, np.abs(x1).sum()))
    base = n * n / rows[0][2]
    print()
    for name, size, seconds, total in rows:
        rate = size * size / seconds
        # Each beside `sweep` on the same grid.
        same = float(np.abs(swept(size).x1_end).sum())
        print(
            f"{name:27s} n={size:4d} {rate:9.0f} runs/s {rate / base:7.3f} of the first, "
            f"sum of |x1| {total:.6f}, off by {abs(total / same - 1):.0e}"
        )
    benchmark(lambda: swept(n))


def test_growth(benchmark):
    """How the cost grows, one table: processor time a run, on one core unless said otherwise."""
    print()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep_threads, "workers", lambda: 1)
        for n in (10, 32, 100, 316):
            _, seconds, _ = least(functools.partial(swept, n))
            print(f"batch of {n * n:7d}      {1e6 * seconds / n**2:9.1f} us a run")
        for tolerance in (1e-4, 1e-6, 1e-8, 1e-10, 1e-11):
            options = dict(rtol=tolerance, atol=tolerance)
            _, seconds, _ = least(functools.partial(swept, 64, **options))
            print(f"tolerance {tolerance:.0e}      {1e6 * seconds / 64**2:9.1f} us a run")
        for belts in (1, 2, 3, 4):
            call = belts_swept(belts)
            start = time.perf_counter()
            call()
            first = time.perf_counter() - start
            _, seconds, _ = least(call)
            cost = f"{1e6 * seconds / 64**2:9.1f} us a run"
            print(f"belts {belts}              {cost}, first call {first:.1f} s")
    times = {}
    for threads in (1, sweep_threads.workers()):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sweep_threads, "workers", lambda n=threads: n)
            swept(256)
            start = time.perf_counter()
            swept(256)
            times[threads] = time.perf_counter() - start
    for threads, seconds in times.items():
        print(
            f"threads {threads}            {256**2 / seconds:9.0f} runs/s, {times[1] / seconds:.2f}"
        )
    benchmark(lambda: swept(100))


def belts_swept(belts):
    law = jb.presets.paper_friction()

    def make(nu0, nu1):
        velocities = [nu0, nu1, -0.25, 0.6][:belts]
        return jb.Oscillator(0.5, tuple(jb.Belt(nu, law, load=1.0) for nu in velocities))

    return lambda: jb.sweep(make, w1(64), y0=(1.5, 0.0), t1=SPAN)


def test_attractor_map(benchmark):
    """The plane of the paper's Fig. 6, 1024 x 1024 labels, on all cores."""
    axes = {name: np.linspace(-0.7, 0.7, n) for name, n in (("nu0", 1024), ("nu1", 1025))}
    axes["nu1"] = axes["nu1"][:-1]

    def call():
        return jb.sweep(jb.presets.class_b, axes, observe="attractor")

    start = time.perf_counter()
    call()
    first = time.perf_counter() - start
    benchmark.pedantic(call, rounds=2)
    warm = benchmark.stats.stats.min
    print(f"\n1024 x 1024 labels: {warm:.1f} s, the first call {first:.1f} s")
