"""Mistakes in how jaxbelt is called, each with what its message must say: run by `test_messages`.

By itself, `python tests/mistakes.py` prints what came of each as a line of JSON. So the annotations
of the package are unchecked there, as they are for its users.
"""

import dataclasses
import json
import math  # noqa: F401
import shlex
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from compilations import compilations
from typer.testing import CliRunner

import jaxbelt as jb

LAW = "a law such as jb.Conti"
OSC = r"osc must be an Oscillator, such as jb.presets.class_b\(...\), got "
SELECTS = "where must be a function that selects one parameter of an oscillator with belts 0 to 1"
PAIR = r"must be \(first, last\), two numbers with first < last, got "
CYCLE = r"cycle must be a Cycle, such as jb.find_cycle\(...\), got "
UNFORCED = "cycle must be a Cycle, .* of an oscillator without forcing, got a PeriodicMotion"
WHOLE = "must be a positive integer, got "
POINT = r"point must be a BifurcationPoint, such as jb.refine\(...\), got "
TARGETS = r"targets must be a list of pairs \(functional, value\), such as .* got "
AXES_OF = r"ax must be axes of matplotlib, such as plt.subplots\(\)\[1\], or None, got "
OBSERVE = '"final", "attractor" or an object with init, update, finish, got '
UNITS = r"; multiply by machine\.units instead$"
TRACED = r" must be known: \w+ is not for jit, vmap or derivatives, got a traced one"
TRACED_MOTION = r" must be known: under jit and vmap use motion.at\(osc\) of .*, got a traced one"

#: What is called, and a pattern of the message; what begins with "jaxbelt" is a command.
MISTAKES = [
    # --- friction laws, belts, oscillators
    ("jb.Cubic(-1.0, 1.0, 1.0)", r"a0 of Cubic must be >= 0, got -1\.0"),
    ("jb.Harmonic(1.0)", "missing 1 required positional argument: 'frequency'"),
    ("jb.Harmonic(1.0, -1.0)", r"frequency of Harmonic must be >= 0, got -1\.0"),
    ("jb.BaseMotion(math.nan, 1.0)", "amplitude of BaseMotion must be finite, got nan"),
    ("jb.Oscillating(0.0, 1.0, 'a')", "frequency must be a number, got 'a'"),
    ("jb.Belt(0.1, law, load=jb.Oscillating(1.0, 2.0, 1.0))", r"mean of load of belt must be >= "),
    ("jb.Oscillator(0.1, (belt,), forcing=1.0)", "forcing must be a force such as jb.Harmonic"),
    ("jb.portrait(jb.presets.di_bernardo(1.7))", "osc must be without a clock: portrait is for"),
    ("jb.Conti(1.0)", "missing 2 required positional arguments: 'residual' and 'steepness'"),
    ("jb.Conti('a', 0.6, 10.0)", "static must be a number, got 'a'"),
    ("jb.Conti(-1.0, 0.6, 10.0)", r"static of Conti must be >= 0, got -1\.0"),
    ("jb.Conti(1.0, 0.6, -10.0)", r"steepness of Conti must be >= 0, got -10\.0"),
    ("jb.Coulomb(0.5, 0.8)", r"kinetic of Coulomb must be <= static = 0\.5, got 0\.8"),
    ("jb.Stribeck(1.0, 0.5, 0.0)", r"velocity of Stribeck must be > 0, got 0\.0"),
    ("jb.Tabulated([0.0, 0.1])", "missing 1 required positional argument: 'coefficients'"),
    ("jb.Tabulated([0.0, 0.1], [0.5])", r"coefficients must be of shape \(2\), got shape \(1,\)"),
    ("jb.Tabulated([0.1, 0.0], [0.5, 0.4])", r"speeds must be increasing, got \[0\.1 0\. \]"),
    ("jb.Tabulated([0.0], [0.5])", "speeds must be two or more, got 1"),
    ("jb.Tabulated([0.0, 0.1], [0.5, -0.4])", r"coefficients must be >= 0, got \[ 0\.5 -0\.4\]"),
    ("jb.Tabulated([0.0, 0.1], [0.5, math.nan])", r"coefficients must be finite, got \[0\.5 nan"),
    ("jb.Tabulated([0.0, 0.1], ['a', 'b'])", r"coefficients must be numbers, got \['a', 'b'\]"),
    ("jb.Tabulated([0, 0.1], [0.5, 0.4], 0.3)", r"mu\(0\) of Tabulated must be <= static = 0\.3"),
    ("jax.jit(lambda c: jb.Tabulated(row, c).static)(row)", "speeds must be known, as coeffic"),
    ("jb.Conti(1 + 2j, 0.6, 10.0)", "static must be float64, got complex128"),
    ("jb.Conti(True, 0.6, 10.0)", "static must be a number, got True"),
    ("jb.Conti([1.0], 0.6, 10.0)", r"static must be a scalar .*, got shape \(1,\)"),
    ("jb.Belt(0.3, law, upper=math.nan)", "upper of belt must be a number, got nan"),
    ("jb.Oscillator(0.5, belts=None)", "belts must be a tuple of belts, .*got None"),
    (
        "jb.Belt(0.3, Worded(1.0, 'soft'))",
        r"word of Worded must be a number .* equinox.field\(static=True\), got 'soft'",
    ),
    ("jb.PhysicalBelt(0.3, Worded(1.0, nu0), 1.0)", "word of Worded .* got the func"),
    ("jb.Belt(0.3, Worded(None, 1.0))", "static of Worded must be a number or an array.* got None"),
    ("jb.Belt(0.3, FadingLaw(1.0))", "mu of FadingLaw must be .* where rate is None, .*TypeError"),
    ("jb.Belt(0.3, NumpyLaw())", "mu of NumpyLaw must be .* JAX can trace .*not .*np.sqrt"),
    ("jb.Belt(0.3, BranchingLaw())", "mu of BranchingLaw must be .* JAX can trace .* or if"),
    ("jb.Belt(0.3)", "missing 1 required positional argument: 'friction'"),
    ("jb.Belt(0.3, 0.5)", f"friction must be {LAW}.*, got 0.5"),
    ("jb.Belt(0.3, jb.Conti)", f"friction must be {LAW}.*, got the class Conti"),
    ("jb.Belt(law, 0.3)", r"velocity must be a number or jb.Oscillating.*, got Conti\("),
    ("jb.Belt(None, law)", "velocity must be a number, got None"),
    ("jb.Belt(math.inf, law)", "velocity of belt must be finite, got inf"),
    ("jb.Belt(0.3, law, load=-1)", r"load of belt must be >= 0, got -1\.0"),
    ("jb.Belt(0.3, law, lower=1.0, upper=0.0)", r"lower of belt must be < upper = 0\.0, got 1\.0"),
    ("jb.Oscillator(0.5, jb.Belt(0.3, law))", r"belts must be a tuple of belts.*, got Belt\("),
    ("jb.Oscillator(0.5, [0.3, 0.4])", r"belts\[0\] must be a Belt, got 0\.3"),
    ("jb.Oscillator(0.5, ())", "belts must be at least one Belt, got none"),
    ("jb.Oscillator(0.5)", "missing 1 required positional argument: 'belts'"),
    ("jb.Oscillator((belt,), 0.5)", r"damping must be a number, got \(Belt\("),
    ("jb.Oscillator([0.5, 0.6], (belt,))", r"damping must be a scalar .*, got shape \(2,\)"),
    ("jb.Oscillator(np.float32(0.5), (belt,))", "damping must be float64, got float32"),
    ("jb.Oscillator(0.5, (belt,), omega=0)", r"omega must be > 0, got 0\.0"),
    (
        "jb.Oscillator(0.5, machine.belts)",
        r"belts\[0\] must be a Belt, got PhysicalBelt\(.*; the .* Machine is machine\.oscillator$",
    ),
    ("jb.Oscillator(dampng=0.5, belts=(belt,))", "takes damping, .*: damping, not dampng"),
    ("jb.plot_sweep(dataset, 'knd')", "variable must be \"kind\", got 'knd'"),
    (
        "jb.Belt(0.3, OwnLaw(lambda r: jnp.ones(3)))",
        r"mu of OwnLaw must .* one float64 a speed, got ",
    ),
    ("jb.Belt(0.3, OwnLaw(lambda r: None))", "mu of OwnLaw must .* one float64 a speed, got None"),
    (
        "jb.Belt(0.3, OwnLaw(lambda: 0.5))",
        "mu of OwnLaw must be a function of the speed, .*argument",
    ),
    ("jb.Conti(1.0, math.nan, 10.0)", "residual of Conti must be finite, got nan"),
    ("jb.Belt(0.3, law, load='1')", "load must be a number, got '1'"),
    ("jb.Belt(0.3, law, lower=1.0, upper=1.0)", r"lower of belt must be < upper = 1\.0, got 1\.0"),
    ("jb.Oscillator(0.5, (belt, None))", r"belts\[1\] must be a Belt, got None"),
    ("jb.Oscillator(0.5, (physical,))", r"belts\[0\] must be a Belt, got PhysicalBelt\("),
    # --- machines
    ("jb.Machine(0.0, 1.0, 0.1, (physical,))", r"mass must be > 0, got 0\.0"),
    ("jb.Machine(m=1.0, k=1.0, c=0.1, belts=(physical,))", "stiffness, not k, damping, not c"),
    ("jb.Machine(spring=2.0, dashpot=3.0)", "forcing: stiffness, not spring, damping, not dashpot"),
    ("jb.Machine(1.0, 1.0, 0.1, belt=physical)", "damping, belts and forcing: belts, not belt"),
    ("jb.Machine(1.0, stifness=1.0)", "damping, belts and forcing: stiffness, not stifness"),
    ("jb.Machine(1.0, omega=1.0)", "Machine.. takes mass, .* and forcing: not omega"),
    ("jb.PhysicalBelt(0.1, law, load=1.0)", "PhysicalBelt.. takes .*: normal_force, not load"),
    ("jb.Machine(1.0, 1.0, 0.1, physical)", r"belts must be a tuple of belts, .*got PhysicalBelt"),
    ("jb.Machine(1.0, 1.0, 0.1, (belt,))", r"belts\[0\] must be a PhysicalBelt, got Belt"),
    ("jb.PhysicalBelt(0.1, law, -1.0)", r"normal_force must be >= 0, got -1\.0"),
    ("jb.PhysicalBelt(0.1, 0.4, 1.0)", f"friction must be {LAW}.*, got 0.4"),
    ("jb.Units(1.0)", "missing 4 required positional arguments"),
    ("jb.Units(1.0, '2', 3.0, 4.0, 5.0)", "length must be a number, got '2'"),
    ("jb.Units(1.0, -2.0, 3.0, 4.0, 5.0)", r"length must be > 0, got -2\.0"),
    ("machine.start('3 mm', 0.0)", "displacement must be a number, got '3 mm'"),
    ("jb.in_si(3.0, machine)", "result must be a Trajectory, .* a Fit, .*, got float"),
    ("jb.in_si(cycle, osc)", r"machine must be a Machine, got Oscillator\("),
    ("jb.plot_in_si(cycle, osc)", r"machine must be a Machine, got Oscillator\("),
    ("jb.in_si(cycle, lambda V: machine)", "got the function .*; a function is for .* a diagram"),
    ("jb.plot_in_si(cycle, lambda V: machine)", "got the .*; a function is for .* fractions"),
    ("jb.plot_in_si(curve, lambda V: machine)", "got the .*; a function is for .* of a sweep"),
    ("jb.in_si(point, machine)", r"got BifurcationPoint; its value is .*\(point.cycle, machine\(p"),
    ("jb.in_si(curve, machine)", "got BifurcationCurve; its values are in the units of the arg"),
    ("jb.in_si(several, machine)", r"got Equilibria; write jb.in_si\(jb.portrait\(osc\), machine"),
    ("jb.explore((1.0, 0.0))", OSC + r"\(1\.0, 0\.0\)"),
    ("jb.explore(osc, (1.0, 0.0, 2.0))", r"start must be of shape \(2\), got shape \(3,\)"),
    ("jb.explore(osc, t1=0)", r"t1 must be > 0, got 0\.0"),
    ("jb.presets.class_b(0.3)", "missing 1 required positional argument: 'nu1'"),
    ("jb.presets.class_b(row, 0.3)", r"velocity must be a scalar .*, got shape \(200,\)"),
    ("jb.presets.class_d(0.3, 0.2, 1.0, 0.0)", r"sigma0 must be <= sigma1 = 0\.0, got 1\.0"),
    # --- one motion
    ("jb.simulate((3.0, 0.0), osc, 10.0)", OSC + r"\(3\.0, 0\.0\)"),
    ("jb.simulate(jb.presets.class_b, (3.0, 0.0), 10.0)", OSC + "the function class_b"),
    ("jb.simulate(osc, (3.0, 0.0))", "missing 1 required positional argument: 't1'"),
    ("jb.simulate(osc, start=(3.0, 0.0), t1=10.0)", "max_events: y0, not start"),
    ("jb.simulate(osc, (3.0, 0.0), tmax=10.0)", "max_events: t1, not tmax"),
    ("jb.simulate(osc, (3.0, 0.0, 1.0), 10.0)", r"y0 must be of shape \(2\), got shape \(3,\)"),
    (
        "jb.simulate(machine, (3.0, 0.0), 10.0)",
        OSC + r"Machine\(.*\.\.\.; give machine\.oscillator$",
    ),
    ("jb.portrait(cycle)", OSC + r"a Cycle; give cycle\.oscillator$"),
    (
        "jb.refine(jb.Hopf(), lambda v: machine, at=0.3)",
        "osc must be .* got one that returns Machine; return machine.oscillator",
    ),
    (
        "jb.sweep(lambda nu0: machine, {'nu0': row}, t1=9.0)",
        "make must be .* got one that returns Machine; return machine.oscillator",
    ),
    (
        "jb.region_map(lambda nu0, nu1: machine, AXES)",
        "make must be .* got one that returns Machine; return machine.oscillator",
    ),
    ("jb.simulate(osc, np.zeros(2, np.float32), 10.0)", "y0 must be float64, got float32"),
    ("jb.simulate(osc, (3.0, 1j), 10.0)", "y0 must be float64, got complex128"),
    ("jb.simulate(osc, (3.0, 0.0), 10.0, t0=20.0)", r"t1 must be > t0 = 20\.0, got 10\.0"),
    ("jb.simulate(osc, (3.0, 0.0), math.inf)", "t1 must be finite, got inf"),
    ("jb.simulate(osc, 3.0, 10.0)", r"y0 must be of shape \(2\), got shape \(\)"),
    ("jb.simulate(osc, (3.0, math.nan), 10.0)", r"y0 must be finite, got \[ 3\. nan\]"),
    ("jb.simulate(osc, {'x1': 3.0}, 10.0)", r"y0 must be numbers, got \{'x1': 3\.0\}"),
    ("jb.simulate(osc, Foreign(), 10.0)", r"y0 must be numbers, got a \w+\.Foreign of string"),
    ("jb.simulate(osc, (3.0, 0.0), '10')", "t1 must be a number, got '10'"),
    ("jb.simulate(osc, (3.0, 0.0), (0, 10))", r"t1 must be a scalar .*, got shape \(2,\)"),
    ("jb.simulate(osc, (3.0, 0.0), -1.0)", r"t1 must be > t0 = 0\.0, got -1\.0"),
    ("jb.simulate(osc, (3.0, 0.0), 10.0, ts=row)", r"ts must be within .*, got .*\(200,\), from 0"),
    ("jb.simulate(osc, (3.0, 0.0), 30.0, ts=row[::-1])", "ts must be increasing, got .*from 20 to"),
    ("jb.simulate(osc, (3.0, 0.0), 10.0, ts=100)", r"ts must be of shape \(n\), got shape \(\)"),
    ("jb.simulate(osc, (3.0, 0.0), 10.0, rtol=-1e-8)", "rtol must be > 0, got -1e-08"),
    (
        "jb.simulate(osc, (3.0, 0.0), 10.0, tol=1e-8)",
        r"^simulate\(\) takes osc, y0, t1, t0, .* and max_events: [ra]tol, not tol$",
    ),
    (
        "jb.simulate(osc, (1.0, 0.0), t_end=5.0)",
        r"simulate\(\) takes osc, y0, t1, .*: t1, not t_end$",
    ),
    ("jb.find_cycle(osc, y_0=(3.0, 0.0))", r"find_cycle\(\) takes osc, y0 and .*: y0, not y_0$"),
    ("jb.simulate(osc, (3.0, 0.0), 9.0, formulation=np.ones(2))", "formulation must be .*got "),
    ("jb.simulate(osc, (3.0, 0.0), 9.0, max_segments=10**400)", "max_segments must be .* at most"),
    (
        "jb.basins(osc, x1=[0.0, 1.0], x2=[0.0, 1.0], t0=np.ones(2))",
        "t0 must be 0 for an oscillator",
    ),
    ("jb.circle_map(jb.presets.di_bernardo(1.7), limit=np.ones(2))", "limit must be 1, -1 or None"),
    ("jb.refine(jb.Hopf(), lambda p: osc, where=lambda o: o.damping)", "where must be left out"),
    ("type('L', (jb.Conti,), {'mu': abs})", "L.mu must not replace that of Conti, .*AbstractFri"),
    ("type('W', (jb.Harmonic,), {'force': abs})", "W.force must not replace that of Harmonic"),
    ("jb.simulate(osc, (3.0, 0.0), 9.0, formulation='exact')", "formulation must be .*got 'exact'"),
    ("jb.simulate(osc, (3.0, 0.0), 9.0, max_segments=1e3)", f"max_segments {WHOLE}1000.0"),
    # --- cycles, equilibria, functionals
    ("jb.find_cycle(osc)", "missing 1 required positional argument: 'y0'"),
    ("jb.find_cycle(osc, (1.0,))", r"y0 must be of shape \(2\), got shape \(1,\)"),
    ("jb.find_cycle(osc, (3.0, 0.0), max_arcs=-3)", f"max_arcs {WHOLE}-3"),
    ("jb.periodic(osc, (0.0, 0.0))", "osc must be with a clock: periodic is for oscillators that"),
    ("jb.circle_map(osc)", "osc must be with a clock: circle_map is for oscillators that"),
    ("jb.lyapunov(osc, (0.0, 0.0))", "osc must be with a clock: lyapunov is for oscillators that"),
    ("jb.SwitchingSliding()", r"SwitchingSliding\(\) takes belt \(the number of a belt"),
    ("jb.AddingSliding()", r"AddingSliding\(\) takes belt \(the number of a belt, such as 0\)"),
    ("jb.refine(jb.Fold(), osc, where=nu0)", "osc must be with a clock: Fold is for oscillators"),
    ("jb.unstable_cycle(osc, around=0.5)", "around must be the number of an eq.*, got 0.5"),
    ("jb.unstable_cycle(osc, max_arcs='many')", f"max_arcs {WHOLE}'many'"),
    ("jb.equilibria([osc, osc])", OSC + r"\[Oscillator\("),
    ("jb.lyapunov_coefficient(None)", OSC + "None"),
    ("jb.portrait('osc')", OSC + "'osc'"),
    ("jb.minimal_fatal_shock('osc', (3.0, 0.0))", OSC + "'osc'"),
    ("jb.minimal_fatal_shock(osc, 3.0)", r"y0 must be of shape \(2\), got shape \(\)"),
    (
        "jb.minimal_fatal_shock(osc, (3.0, 0.0), direction='x1')",
        'direction must be "both" or "x2", got \'x1\'',
    ),
    ("jb.distance_to_basin_boundary('x3')", 'direction must be "both" or "x2", got \'x3\''),
    ("jb.amplitude(osc)", CYCLE + r"Oscillator\("),
    ("jb.period(None)", CYCLE + "None"),
    ("jb.peak(cycle, 'x3')", 'coordinate must be "x1" or "x2", got \'x3\''),
    ("jb.stick_duration(cycle, belt=5)", "belt must be 0 to 1, got 5"),
    ("jb.stick_duration(of_one, belt=1)", "belt must be 0: there is one belt, got 1"),
    ("jb.refine(jb.NonsmoothFold(1), one, where=nu0)", "belt must be 0: there is one belt, got 1"),
    ("jb.refine(jb.Hopf(), one, where=lambda osc: 0.5)", r"got 0\.5, a number that is no par"),
    ("jb.refine(jb.Hopf(), one, where=0)", "parameter of an oscillator with one belt, 0, unch"),
    ("jb.refine(jb.SaddleConnection(0, 1), one, where=nu0)", "to must be 0, or None: there is one"),
    ("jb.stick_duration(cycle, belt=True)", "belt must be 0 to 1, got True"),
    ("cycle.sample(0)", f"n {WHOLE}0"),
    ("jb.describe('OK')", "status must be a Status, or its number, got 'OK'"),
    ("jb.stick_fraction(3.0)", CYCLE + r"3\.0"),
    ("jb.slip_duration(cycle, '0')", "belt must be 0 to 1, got '0'"),
    ("jb.gap(osc, 0)", CYCLE + r"Oscillator\("),
    ("jb.energy_fed(osc)", CYCLE + r"Oscillator\("),
    ("jb.energy_dissipated(cycle.chain)", CYCLE + "None"),
    ("jb.describe(99)", "status must be a Status, or its number, got 99"),
    ("jb.unstable_cycle(osc, around=99)", "around must be the number of an equil.*, 0, got 99"),
    ("jb.unstable_cycle(osc, around=True)", "around must be the number of an .*, 0, got True"),
    ("jb.unstable_cycle(edged, around=3)", "around must be the number of an .*, 0 to 2, got 3"),
    ("jb.minimal_fatal_shock(osc, cycle)", "y0 must be numbers, got a Cycle"),
    ("jb.find_cycle(osc, (math.inf, 0.0))", r"y0 must be finite, got \[inf  ?0\.\]"),
    ("jb.stick_duration([cycle], belt=0)", CYCLE),
    ("jb.simulate(osc, cycle, 10.0)", "y0 must be numbers, got a Cycle"),
    # --- bifurcations
    ("jb.refine(jb.Hopf, osc, where=nu0)", "condition must be such as .*, got the class Hopf"),
    ("jb.refine(osc, jb.Hopf(), where=nu0)", r"condition must be such as .*, got Oscillator\("),
    ("jb.refine(jb.Hopf(), osc)", SELECTS + ".*, got None"),
    ("jb.refine(jb.HopfAtInfinity(), osc)", SELECTS + ".*, got None"),
    ("jb.refine(jb.Hopf(), osc, where='nu0')", SELECTS + ".*, got 'nu0'"),
    ("jb.refine(jb.Hopf(), osc, where=nu2)", SELECTS + ".*, got one of a belt that is not there"),
    ("jb.refine(jb.Hopf(), osc, where=both)", SELECTS + r".*, got \(belts\[0\]\.v.*, belts\[1\]"),
    ("jb.refine(jb.Hopf(), osc, where=lambda o: o.belts[0])", SELECTS + ".*, got a whole Belt"),
    ("jb.refine(jb.Hopf(), osc, where=lambda o: 0.3)", SELECTS + r".*, got 0\.3"),
    ("jb.refine(jb.Hopf(), osc, where=nu0, at=0.3)", r"at must be left out where .*, got 0\.3"),
    (
        "jb.refine(jb.Hopf(), jb.presets.class_a)",
        "at must be the value of the parameter .*got None",
    ),
    ("jb.refine(jb.Hopf(), lambda v: v, at=0.3)", "osc must be .* got one that returns a number"),
    (
        "jb.refine(jb.Hopf(), jb.presets.class_b, at=0.3)",
        r"osc must be .*, got one of \(nu0, nu1\)",
    ),
    (
        "jb.refine(jb.NonsmoothFold(), osc, where=nu0)",
        r"NonsmoothFold\(\) takes belt \(the number of a .*, such as 0\): missing .*: 'belt'",
    ),
    ("jb.EdgeExchange()", r"takes belts \(the numbers of two belts, .*: missing .* 'belts'"),
    ("jb.Hopf(0)", r"Hopf\(\) takes nothing: too many positional arguments"),
    ("jb.refine(jb.NonsmoothFold(2), osc, where=nu0)", "belt must be 0 to 1, got 2"),
    ("jb.refine(jb.GrazingSliding(1.0), osc, where=nu0)", r"belt must be 0 to 1, got 1\.0"),
    ("jb.refine(jb.CrossingSliding('1'), osc, where=nu0)", "belt must be 0 to 1, got '1'"),
    ("jb.refine(jb.SuddenSliding(-1), osc, where=nu0)", "belt must be 0 to 1, got -1"),
    ("jb.refine(jb.BeltAtRest(None), osc, where=nu0)", "belt must be 0 to 1, got None"),
    ("jb.refine(jb.SlidingExchange(0), osc, where=nu0)", "belts must be two different .*, got 0"),
    ("jb.refine(jb.EdgeExchange(0), osc, where=nu0)", "belts must be two different .*, got 0"),
    (
        "jb.refine(jb.MeetingEdges((0, 1)), osc, where=nu0)",
        r"belts must be two with a finite edge, got \(0, 1\)",
    ),
    ("jb.refine(jb.GrazingEdge(0), osc, where=nu0)", "belt must be one with a finite edge, got 0"),
    ("jb.refine(jb.SaddleConnection(0), osc, where=nu0)", "belt must be one with a finite edge"),
    (
        "jb.refine(jb.SaddleConnection(0, 'left'), jb.presets.class_c(0.1, 0.3, 0.2), where=nu0)",
        "to must be 0 to 1, or None, got 'left'",
    ),
    ("jb.refine(jb.CornerCollision(0), osc, where=nu0)", "belt must be one with a finite edge"),
    ("jb.refine(jb.PseudoHopf(1), osc, where=nu0)", "belt must be one with a finite edge, got 1"),
    ("jb.refine(jb.BoundaryEquilibrium(1), osc, where=nu0)", "belt must be one with a finite edge"),
    ("jb.refine(jb.FoldOfCycles(), osc, where=nu0, max_arcs=0)", f"max_arcs {WHOLE}0"),
    ("jb.scan(osc, nu0)", "span " + PAIR + "None"),
    ("jb.scan(jb.presets.class_a, (0.1, 0.5))", r"span must be given by .* span=\(0\.1, 0\.5\)"),
    ("jb.scan(osc, (-0.7, 0.7))", SELECTS + r".*, got \(-0\.7, 0\.7\)"),
    ("jb.scan(osc, nu0, (0.7, -0.7))", "span " + PAIR + r"\(0\.7, -0\.7\)"),
    ("jb.scan(osc, nu0, (0.1, math.nan))", r"span must be finite, got \[0\.1 nan\]"),
    ("jb.scan(osc, lambda o: o.omega, (-1.0, 1.0))", r"omega must be > 0, got -1\.0"),
    ("jb.scan(osc, nu0, (-0.7, 0.7), resolution=0)", f"resolution {WHOLE}0"),
    ("jb.scan(osc, nu0, (-0.7, 0.7), conditions=jb.Hopf())", r"conditions must be .* got Hopf\(\)"),
    ("jb.scan(osc, nu0, (0.1, 0.7, 0.9))", "span " + PAIR + r"\(0\.1, 0\.7, 0\.9\)"),
    ("jb.scan(osc, nu0, ('a', 'b'))", r"span must be numbers, got \('a', 'b'\)"),
    ("jb.refine('hopf', osc, where=nu0)", "condition must be such as .*, got 'hopf'"),
    ("jb.refine(jb.Hopf(), jb.presets.class_a, at=math.nan)", "at must be finite, got nan"),
    ("jb.scan(jb.presets.class_a, nu0, (0.1, 0.7))", "where must be left out .*got the function"),
    ("jb.bifurcation_diagram(osc, nu0, row)", "span " + PAIR + r"an array of .*\(200,\)"),
    ("jb.bifurcation_diagram(osc, nu0, (0.1, 0.7), rows=20.0)", f"rows {WHOLE}20.0"),
    ("jb.orbit_diagram(jb.presets.class_a, [0.1, 0.5])", r"span must be given by its name, span="),
    ("jb.orbit_diagram(osc, nu0)", "span " + PAIR + "None"),
    ("jb.orbit_diagram(osc, 'nu0', (0.1, 0.7))", SELECTS + ".*, got 'nu0'"),
    ("jb.orbit_diagram(osc, nu0, (0.1, 0.7), at='x1')", "at must be an AtExtrema, .* got 'x1'"),
    ("jb.orbit_diagram(osc, nu0, (0.1, 0.7), rows=1)", "rows must be an integer >= 2, got 1"),
    ("jb.orbit_diagram(osc, nu0, (0.1, 0.7), y0=3.0)", r"y0 must be of shape \(2\), got shape"),
    ("jb.orbit_diagram(osc, nu0, (0.1, 0.7), y0=[[1, 2, 3]])", r"y0 must be of shape \(n, 2\)"),
    ("jb.orbit_diagram(osc, nu0, (0.1, 0.7), sense='rising')", "sense must be .*'rising'"),
    (
        "jb.orbit_diagram(osc, nu0, (0.1, 0.7), y0=[(3, 0), (1, 0)], sense='up')",
        "y0 must be one start where sense is given",
    ),
    ("jb.orbit_diagram(osc, nu0, (0.1, 0.7), atol=0)", r"atol must be > 0, got 0\.0"),
    ("jb.orbit_diagram(osc, lambda o: o.omega, (-1.0, 1.0))", r"omega must be > 0, got -1\.0"),
    ("jb.bifurcation_curve(osc, (nu0, nu1), PLANE)", POINT + r"Oscillator\("),
    ("jb.bifurcation_curve((), (nu0, nu1), PLANE)", POINT + r"\(\)"),
    ("jb.bifurcation_curve(failed, (nu0, nu1), PLANE)", "point must be one with status OK, got"),
    (
        "jb.bifurcation_curve(point, nu0, PLANE)",
        "where must be a function of two numbers .*got one",
    ),
    ("jb.bifurcation_curve(point, (nu0, nu0), PLANE)", "where must be two different .*, got one t"),
    ("jb.bifurcation_curve(point, (nu0, nu1), (-1, 1))", r"span must be .*, got \(-1, 1\)"),
    (
        "jb.bifurcation_curve(point, (nu0, nu1), ((1, -1), (-1, 1)))",
        r"span\[0\] must .*got \(1, -1",
    ),
    ("jb.bifurcation_curve(point, (nu0, nu1), PLANE, step=-1)", r"step must be > 0, got -1\.0"),
    ("jb.region_map(jb.presets.class_b, {'nu0': row})", r"axes must be a dictionary, two .*'nu0'"),
    ("jb.region_map(jb.presets.class_b, [row, row])", "axes must be a dictionary, two .*an array"),
    (
        "jb.region_map(jb.presets.class_b, {'nu0': row, 'mu1': row})",
        "axes must be .* got 'mu1' .*nu1",
    ),
    (
        "jb.region_map(jb.presets.class_c, {'nu0': row, 'nu1': row})",
        "make must .* needs sigma, too",
    ),
    ("jb.region_map(jb.presets.class_b, AXES, starts=(3.0, 0.0))", r"starts must .*got \(3\.0, 0"),
    ("jb.region_map(jb.presets.class_b, AXES, lines=-1)", "lines must be an integer >= 0, got -1"),
    ("jb.refine(jb.NonsmoothFold(True), osc, where=nu0)", "belt must be 0 to 1, got True"),
    (
        "jb.refine(jb.GrazingEdge(0, 'middle'), edged, where=nu0)",
        "unstable must be True or False, got 'middle'",
    ),
    ("jb.refine(jb.Hopf(), osc, where=(nu0, nu1))", SELECTS),
    ("jb.refine(jb.Hopf(), osc, where=lambda o: o.nothing)", SELECTS + ".*'nothing'"),
    ("jb.scan(osc, nu0, (0.3, 0.3))", "span " + PAIR + r"\(0\.3, 0\.3\)"),
    ("jb.scan(osc, nu0, (0.1, 0.7), conditions=[jb.Hopf])", "conditions must be .*the class Hopf"),
    ("jb.scan(lambda nu: None, span=(0.1, 0.7))", "osc must be .* got one that returns NoneType"),
    (
        "jb.orbit_diagram(osc, nu0, (0.1, 0.7), at=jb.AtSection(lambda o: 1.0))",
        r"function of AtSection must be a function of \(osc, x1, x2\) .*got TypeError",
    ),
    (
        "jb.orbit_diagram(osc, nu0, (0.1, 0.7), at=jb.AtSection(lambda o, a, b: (a, b)))",
        "function of AtSection must be .* returns one number, got a tuple of 2 arrays",
    ),
    (
        "jb.orbit_diagram(osc, nu0, (0.1, 0.7), at=jb.AtSection(lambda o, a, b: math.sqrt(a)))",
        "function of AtSection must be .* made of what JAX can trace",
    ),
    (
        "jb.region_map(jb.presets.class_b, {'nu0': (0, 1), 'nu1': row})",
        r"nu0 must be all values, increasing, such as np.linspace\(0, 1, 201\), got \(0, 1\)",
    ),
    ("jb.region_map(jb.presets.class_b, {'nu0': row, 'nu1': [0.3]})", "nu1 must be two values or"),
    # --- sweeps and basins
    (
        "jb.sweep(jb.presets.class_b, {'nu0': row})",
        "make must be .* needs nu1, too: functools.part",
    ),
    ("jb.sweep(osc, AXES, t1=10.0)", r"make must be a function .*, got Oscillator\("),
    ("jb.sweep(AXES, jb.presets.class_b, t1=10.0)", "make must be a function .*, got {'nu0'"),
    ("jb.sweep(jb.presets.class_b, {}, t1=10.0)", r"axes must be a dictionary of values, got \{\}"),
    ("jb.sweep(jb.presets.class_b, {'nu': row, 'nu1': row})", "axes must be .*got 'nu' .*mean 'nu"),
    ("jb.sweep(jb.presets.class_b, AXES | {'nu0': []})", "axis nu0 must be at least one value"),
    (
        "jb.sweep(jb.presets.class_b, AXES | {'nu0': 0.3})",
        r"axis nu0 must be of .*, got shape \(\)",
    ),
    (
        "jb.sweep(jb.presets.class_b, AXES | {'nu0': ['a', 'b']})",
        "axis nu0 must be numbers, got .'a",
    ),
    ("jb.sweep(jb.presets.class_b, AXES | {'nu0': np.ones((3, 3))})", r"axis nu0 must .*\(3, 3\)"),
    (
        "jb.sweep(lambda nu0: 3.0, {'nu0': row}, t1=9.0)",
        "make must be .* got one that returns float",
    ),
    ("jb.sweep(with_float, {'nu0': row}, t1=9.0)", "make must be .* JAX can trace .* float or if"),
    (
        "jb.sweep(jb.presets.class_b, AXES | {3: row}, t1=9.0)",
        r"axes must be arguments of make \(nu0, nu1\), x1 or x2, got 3",
    ),
    (
        "jb.sweep(jb.presets.class_b, AXES, t1=9.0, derivatives=('nu0', 'nu0'))",
        r"derivatives must be free of repeats, got \('nu0', 'nu0'\)",
    ),
    ("jb.sweep(jb.presets.class_b, AXES, t1=9.0, atol=math.nan)", "atol must be finite, got nan"),
    ("jb.sweep(jb.presets.class_b, AXES)", "t1 must be given, .*, got None"),
    ("jb.sweep(jb.presets.class_b, AXES, t1=-9.0)", r"t1 must be > 0, got -9\.0"),
    ("jb.sweep(jb.presets.class_b, AXES, t1=9.0, y0=(3.0,))", r"y0 must be of shape \(2\), got"),
    (
        "jb.sweep(jb.presets.class_b, AXES, observe='atractor')",
        OBSERVE + "'atractor' .did you mean",
    ),
    ("jb.sweep(jb.presets.class_b, AXES, t1=9.0, observe=Reducer)", OBSERVE + "the class Reducer"),
    (
        "jb.sweep(jb.presets.class_b, AXES, t1=9.0, observe=Reducer())",
        "observe.finish must be .*dict",
    ),
    (
        "jb.sweep(jb.presets.class_b, AXES, t1=9.0, observe=Growing())",
        "observe.update must be .*tuple",
    ),
    (
        "jb.sweep(jb.presets.class_b, AXES, t1=9.0, derivatives='nu3')",
        "derivatives must .*got 'nu3'",
    ),
    (
        "jb.sweep(jb.presets.class_b, AXES, t1=9.0, store=3)",
        "store must be the path of a .*, got 3",
    ),
    (
        "jb.sweep(jb.presets.class_b, AXES, t1=9.0, blocks=(0, 4))",
        "store must be given, where block",
    ),
    ("jb.sweep(jb.presets.class_b, AXES, t1=9.0, audit=2)", r"audit must be a share .*, got 2\.0"),
    (
        "jb.sweep(jb.presets.class_b, AXES, t1=9.0, progress='yes')",
        "progress must be True, .*'yes'",
    ),
    ("jb.explain(jb.presets.class_b, AXES, observe='finl')", OBSERVE + "'finl' .did you mean 'fin"),
    ("jb.verify('nowhere.zarr')", "path must be that of a store, a folder, got nowhere.zarr"),
    ("jb.decoded('sweep.nc')", "dataset must be an xarray.Dataset, .*, got 'sweep.nc'"),
    ("jb.attractors({'kind': 3})", r"dataset must be an xarray.Dataset, .*, got \{'kind': 3\}"),
    ("jb.AtExtrema('x3')", 'of must be "x1" or "x2", got \'x3\''),
    ("jb.AtSection('x1')", "function must be a function of osc, x1 and x2, got 'x1'"),
    ("jb.AtPhase(math.nan)", "phase must be a finite angle, got nan"),
    ("jb.AtTimes([3.0, 1.0])", r"times must be .*increasing, got \[3\. 1\.\]"),
    ("jb.basins(osc, x1=(0, 3), x2=(-1, 1))", r"x1 must be .*linspace\(0, 3, 201\), got \(0, 3\)"),
    ("jb.basins(osc, x1=(1, 0), x2=(0, 1))", r"x1 .*linspace\(0, 1, 201\), got \(1, 0\)$"),
    ("jb.basins(osc, x1=(0, 3), x2=row)", r"got \(0, 3\); for two values write \[0, 3\]$"),
    ("jb.basins(osc, x=row, x2=row)", r"basins\(\) takes oscillator, x1, .*: x1, not x$"),
    ("jb.sweep(jb.presets.class_b, AXES, t_1=9.0)", r"sweep\(\) takes make, .*: t1, not t_1$"),
    ("jb.basins(osc, row, row)", "takes 1 positional argument but 3 were given"),
    ("jb.basins(osc, x1=row[::-1], x2=row)", "x1 must be increasing, got an array .*from 20 to 0"),
    (
        "jb.basin_stability(osc, box=BOX, key=0)",
        r"key must be one key, .*jax.random.key\(0\), got 0",
    ),
    ("jb.basin_stability(osc, box=(0, 3, -1, 1), key=key)", r"box must be .*, got \(0, 3, -1, 1\)"),
    (
        "jb.basin_stability(osc, box=((3, 0), (-1, 1)), key=key)",
        r"box\[0\], x1 must .*got \(3, 0\)",
    ),
    ("jb.basin_fractions(osc, nu0, box=BOX, key=key)", "span " + PAIR + "None"),
    ("jb.basin_fractions(osc, 'nu0', (0.1, 0.7), box=BOX, key=key)", SELECTS + ".*, got 'nu0'"),
    ("jb.basin_fractions(osc, nu0, (0.1, 0.7), box=(0, 1), key=key)", r"box must be .*\(0, 1\)"),
    ("jb.basin_fractions(osc, nu0, (0.1, 0.7), box=BOX, key=3)", "key must be one key, .* got 3"),
    ("jb.lyapunov(forced, (1.0, 0.0), key=3)", "key must be one key, .* got 3"),
    (
        "jb.basin_fractions(osc, nu0, (0.1, 0.7), box=BOX, key=key, rows=1)",
        "rows must be an integer >= 2, got 1",
    ),
    (
        "jb.basin_fractions(osc, nu0, (0.1, 0.7), box=BOX, key=key, moves=0)",
        r"moves must be > 0, got 0\.0",
    ),
    (
        "jb.basin_fractions(osc, lambda o: o.omega, (-1.0, 1.0), box=BOX, key=key)",
        r"omega must be > 0, got -1\.0",
    ),
    ("jb.basin_stability(osc, box=BOX, key=key, n=1e4)", f"n {WHOLE}10000.0"),
    (
        "jb.sweep(jb.presets.class_b, AXES, t1=9.0, observe=Numbered())",
        r"observe.finish must be .* by their names, got \[1\]",
    ),
    (
        "jb.sweep(keyed('nu'), {'nu': row}, t1=9.0, observe=Made(init=lambda osc, a, b: 0))",
        "observe.update must be .* types that init returns, got float64 where init returns int64",
    ),
    (
        "jb.sweep(keyed('nu'), {'nu': row}, t1=9.0, observe=Made(rates=lambda o, m: m.forces))",
        r"observe.rates must be .* of numbers, got an array of float64 of shape \(1,\)",
    ),
    (
        "jb.sweep(keyed('nu'), {'nu': row}, t1=9.0, observe=Made(finish=lambda s, e: {'z': 1j}))",
        "observe.finish must be .* real results, got complex numbers for z",
    ),
    (
        "jb.sweep(keyed('nu'), {'nu': row}, t1=9.0, observe=Made(finish=lambda s, e: {'z': None}))",
        "observe.finish must be .* numbers, or vectors, by their names, got .* for z",
    ),
    (
        "jb.sweep(keyed('nu'), {'nu': row}, t1=9.0, observe=Made(finish=lambda s, e: {'z': {}}))",
        "observe.finish must be .* numbers, or vectors, by their names, got a dict .* for z",
    ),
    (
        "jb.sweep(jb.presets.class_b, AXES, t1=9.0, observe=Sectioned())",
        "function of AtSection must be .* returns one number, got an array of bool",
    ),
    (
        "jb.sweep(keyed('status'), {'status': row}, t1=9.0)",
        "axes must be named otherwise than a result, .*ledger, .* got 'status'",
    ),
    ("jb.sweep(keyed('kind'), {'kind': row}, observe='attractor')", "axes must .* got 'kind'"),
    ("jb.sweep(keyed('belt'), {'belt': row}, t1=9.0)", "axes must be named .* got 'belt'"),
    ("jb.sweep(keyed('ledger'), {'ledger': row}, t1=9.0)", "axes must be named .* got 'ledger'"),
    ("jb.sweep(keyed('a/b'), {'a/b': row}, t1=9.0)", "axes must be .* without /, got 'a/b'"),
    (
        "jb.sweep(keyed('nu'), {'nu': row}, t1=9.0, observe=Named('nu'))",
        "axes must be named otherwise than a result, .* got 'nu'",
    ),
    (
        "jb.sweep(keyed('nu'), {'nu': row}, t1=9.0, observe=Named('ledger'))",
        "observe must be an observable whose results are named otherwise .* got 'ledger'",
    ),
    (
        "jb.sweep(keyed('nu'), {'nu': row}, t1=9.0, observe=Named('status'))",
        "observe.finish must be .* without status, which is the run's own, got one with it",
    ),
    ("jb.verify('nowhere.zarr', repair='yes')", "repair must be True or False, got 'yes'"),
    ("jb.basins(osc, x1=row, x2=row, progress='yes')", "progress must be True, .*got 'yes'"),
    (
        "jb.basin_stability(osc, box=BOX, key=keys)",
        r"key must be one key, .*got an array of key<fry> of shape \(3,\)",
    ),
    # --- from data to parameters
    ("jb.fit(osc, row, row)", "missing 1 required keyword-only argument: 'where'"),
    ("jb.fit(row, row, osc, where=nu0)", "oscillator must be an Oscillator, .* got an array"),
    ("jb.fit(osc, row, 0 * row, where=nu0)", "x1 must be a record that changes, got one number"),
    ("jb.fit(osc, row, where=nu0)", "x1 must be given, or x2, got None"),
    ("jb.fit(osc, row, row[:-1], where=nu0)", r"x1 must be of shape \(200\), got shape \(199,\)"),
    (
        "jb.fit(osc, row[::-1], row, where=nu0)",
        "ts must be increasing, got an array .*from 20 to 0",
    ),
    ("jb.fit(osc, row[:5], row[:5], where=nu0)", "ts must be at least 8 times, got 5"),
    ("jb.fit(osc, row, row * math.nan, where=nu0)", "x1 must be at least 8 data, got 0"),
    ("jb.fit(osc, row, row.astype(np.float32), where=nu0)", "x1 must be float64, got float32"),
    ("jb.fit(osc, row, row, where=nu0, noise=0.0)", r"noise must be > 0, got 0\.0"),
    ("jb.fit(osc, row, row, row, where=nu0, noise=0.1)", r"noise must be a pair, .*got 0\.1"),
    (
        "jb.fit(osc, row, row, where=nu0, bounds=(0.0, 1.0))",
        r"bounds must be a list .*got \(0\.0, 1",
    ),
    (
        "jb.fit(osc, row, row, where=nu0, bounds=[(1.0, 0.0)])",
        r"bounds of belts\[0\].* got \(1\.0, 0",
    ),
    (
        "jb.fit(osc, row, row, where=nu0, bounds=[(0.5, 1.0)])",
        "velocity must be inside .* got 0.45",
    ),
    (
        "jb.fit(osc, row, row, where=twice)",
        r"where must be free of repeats, got \(damping, damping",
    ),
    ("jb.fit(osc, row, row, where=nu0, starts=0)", f"starts {WHOLE}0"),
    ("jb.fit(osc, row, row, where=nu0, report='loud')", "report must be a function .*, got 'loud'"),
    ("jb.design(osc, jb.amplitude, where=nu0)", TARGETS + "the function amplitude"),
    ("jb.design(osc, (jb.amplitude, 1.0), where=nu0)", TARGETS + r"\(the function amplitude, 1\.0"),
    ("jb.design(osc, [(jb.amplitude, 'big')], where=nu0)", "target of amplitude must be numbers"),
    ("jb.design(osc, [(jb.amplitude, (2, 1))], where=nu0)", r"target of amplitude .*got \(2, 1\)"),
    (
        "jb.design(osc, TARGET, where=nu0, bounds=[(1.0, 0.5)])",
        r"bounds of belts\[0\].* got \(1\.0,",
    ),
    ("jb.distance_to(jb.Hopf, where=nu0)", "conditions must be a tuple .*, got the class Hopf"),
    ("jb.distance_to(jb.Hopf(), where='nu0')", "where must be a function .*, got 'nu0'"),
    (
        "jb.design(osc, [(lambda c: 'a', 1.0)], where=nu0)",
        "functional of targets must be .*TypeErr",
    ),
    (
        "jb.design(osc, [(lambda c: c.nothing, 1.0)], where=nu0)",
        "functional of targets must be .*'nothing'",
    ),
    (
        "jb.design(osc, [(lambda c: c.stick_durations, 1.0)], where=nu0)",
        "functional of targets must be .* one number, got .* of shape .2,.",
    ),
    (
        "jb.design(osc, [(lambda c: math.sqrt(c.period), 1.0)], where=nu0)",
        "functional of targets must be .* made of what JAX can trace",
    ),
    ("jb.design(forced, [(jb.energy_fed, 1.0)], where=lambda o: o.damping)", UNFORCED),
    ("jb.design(forced, [(lambda m: jb.gap(m, 0), 1.0)], where=lambda o: o.damping)", UNFORCED),
    (
        "jb.design(forced, [(jb.distance_to_basin_boundary(), 1.0)], where=lambda o: o.damping)",
        "osc must be without a clock: distance_to_basin_boundary is for oscillators that do not",
    ),
    (
        "jb.fit(forced, row, row, where=lambda o: o.forcing[1].phase)",
        "where must be a function that selects parameters",
    ),
    (
        "jb.fit(forced, row, row, where=lambda o: o.forcing[0].frequency, bounds=[(2.0, 3.0)])",
        r"forcing\[0\].frequency must be inside of its bounds \(2, 3\), got 1.7",
    ),
    # --- in jit, vmap or derivatives
    ("jax.jit(lambda osc: jb.scan(osc, nu0, (0.1, 0.7)))(osc)", "osc" + TRACED),
    ("jax.vmap(lambda end: jb.scan(osc, nu0, (0.1, end)))(row)", "span" + TRACED),
    ("jax.jit(lambda osc: jb.bifurcation_diagram(osc, nu0, (0.1, 0.7)))(osc)", "osc" + TRACED),
    ("jax.jit(lambda osc: jb.orbit_diagram(osc, nu0, (0.1, 0.7)))(osc)", "osc" + TRACED),
    (
        "jax.jit(lambda s: jb.bifurcation_curve(point, (nu0, nu1), PLANE, step=s))(1)",
        "step" + TRACED,
    ),
    ("jax.jit(lambda k: jb.region_map(jb.presets.class_b, k))(AXES)", "axes" + TRACED),
    ("jax.jit(lambda k: jb.sweep(jb.presets.class_b, k, t1=9.0))(AXES)", "axes" + TRACED),
    (
        "jax.jit(lambda _: jb.sweep(jb.presets.class_b, AXES, t1=9.0))(0.1)",
        "sweep must be called outside of jax.jit: sweep is not for jit, vmap or derivatives",
    ),
    ("jax.jit(lambda k: jb.explain(jb.presets.class_b, k, t1=9.0))(AXES)", "axes" + TRACED),
    ("jax.jit(lambda osc: jb.basins(osc, x1=row, x2=row))(osc)", "oscillator" + TRACED),
    ("jax.vmap(lambda x: jb.basins(osc, x1=row, x2=x))(AXES['nu0'][None])", "x2" + TRACED),
    ("jax.jit(lambda key: jb.basin_stability(osc, box=BOX, key=key))(key)", "key" + TRACED),
    (
        "jax.jit(lambda osc: jb.basin_fractions(osc, nu0, (0.1, 0.7), box=BOX, key=key))(osc)",
        "osc" + TRACED,
    ),
    ("jax.jit(lambda x: jb.fit(osc, row, x, where=nu0))(row)", "x1" + TRACED),
    ("jax.grad(lambda x: jb.design(osc, [(jb.amplitude, x)], where=nu0))(1.0)", "targets" + TRACED),
    ("jax.jit(jb.portrait)(osc)", "osc" + TRACED),
    (
        "jax.jit(lambda osc: jb.minimal_fatal_shock(osc, (3.0, 0.0)))(osc)",
        "osc must be known: shocks are not for jit or vmap, got a traced one",
    ),
    (
        "jax.jit(lambda y: jb.minimal_fatal_shock(osc, y))(row[:2])",
        "y0 must be known: shocks are not for jit or vmap, got a traced one",
    ),
    ("jax.jit(lambda y: jb.find_cycle(forced, y))(row[:2])", "^y0" + TRACED_MOTION),
    ("jax.vmap(lambda y: jb.find_cycle(forced, y))(row[None, :2])", "^y0" + TRACED_MOTION),
    ("jax.jit(lambda osc: jb.find_cycle(osc, (1.0, 0.0)))(forced)", "^osc" + TRACED_MOTION),
    (
        "jax.jit(lambda _: jb.find_cycle(forced, (1.0, 0.0)))(0.1)",
        "find_cycle must be called outside of jax.jit: under jit and vmap use motion.at",
    ),
    ("jax.jit(lambda y: jb.periodic(forced, y))(row[:2])", "^guess" + TRACED_MOTION),
    ("jax.jit(lambda y: jb.lyapunov(forced, y))(row[:2])", "^y0" + TRACED),
    (
        "jax.jit(lambda _: jb.lyapunov(forced, (1.0, 0.0)))(0.1)",
        "lyapunov must be called outside of jax.jit: lyapunov is not for jit, vmap or derivatives",
    ),
    (
        "jax.jit(lambda y: jb.refine(jb.PeriodDoubling(), forced, where=damped, start=y))(row[:2])",
        "start must be known: points of forced oscillators are not for jit or vmap, got a traced",
    ),
    ("jax.jit(lambda one: jb.in_si(cycle, one))(machine)", "machine" + TRACED + UNITS),
    (
        "jax.jit(lambda _: jb.in_si(cycle, machine))(0.1)",
        "in_si must be called outside of jax.jit: .* derivatives" + UNITS,
    ),
    # --- pictures
    ("jb.plot_friction_law(osc)", r"friction must be a law .*, got Oscillator\("),
    ("jb.plot_friction_law(law, unit=3)", 'unit must be a text such as "m/s", got 3'),
    ("jb.plot_time_history(osc)", r"trajectory must be a Trajectory, .*, got Oscillator\("),
    ("jb.plot_phase_portrait((), osc)", OSC + r"\(\)"),
    ("jb.plot_phase_portrait(osc, osc)", r"trajectories must be .*, got Oscillator\("),
    ("jb.plot_phase_portrait(osc, xlim=(1, 0))", "xlim " + PAIR + r"\(1, 0\)"),
    ("jb.plot_vector_field(osc, kind='arrow')", "kind must be .*, got 'arrow' .did you mean"),
    ("jb.plot_sweep('sweep.nc', 'kind')", "dataset must be an xarray.Dataset, .*got 'sweep.nc'"),
    ("jb.plot_basins(osc)", r"basins must be what jb.basins returns, got Oscillator\("),
    ("jb.show_progress('yes')", "wanted must be True, False or None, got 'yes'"),
    ("cycle.plot('here')", AXES_OF + "'here'"),
    ("point.plot(ax=3)", AXES_OF + "3"),
    ("jb.plot_friction_law(law, 'here')", AXES_OF + "'here'"),
    ("jb.plot_friction_law(law, speed='fast')", "speed must be a number, got 'fast'"),
    ("jb.plot_phase_portrait(osc, ax='here')", AXES_OF + "'here'"),
    ("jb.plot_phase_portrait(osc, equilibria='none')", "equilibria must be what .*got 'none'"),
    ("jb.plot_phase_portrait(osc, cycles=cycle)", "cycles must be a list of cyc.*, got a Cycle"),
    ("jb.plot_vector_field(osc, ax='here')", AXES_OF + "'here'"),
    ("jb.plot_vector_field(osc, ylim=3)", "ylim " + PAIR + "3"),
    ("jb.plot_sweep(dataset, 'kind', 'here')", AXES_OF + "'here'"),
    ("jb.plot_in_si(cycle, machine, ax='here')", AXES_OF + "'here'"),
    ("jb.plot_time_history([cycle])", r"trajectory must be a Trajectory, .*, got \[a Cycle\]"),
    ("jb.plot_time_history(run, 'here')", "ax must be two axes of matplotlib, .*, got 'here'"),
    (
        "jb.plot_time_history(run, ('upper', 'lower'))",
        "ax must be two axes of matplotlib, .*'upper",
    ),
    # --- the command line
    ("jaxbelt simulat", "No such command 'simulat'"),
    ("jaxbelt simulate --class q", "class must be a, b, c or d, got q"),
    ("jaxbelt simulate --class b --sigma 1", "class b must have only nu0, nu1, got sigma"),
    ("jaxbelt simulate --t1 -1", r"t1 must be finite and > 0, got -1\.0"),
    ("jaxbelt simulate --t1 long", "Invalid value for '--t1': .* valid (float|number)"),
    ("jaxbelt simulate --nu0 nan", "velocity of belt must be finite, got nan"),
    ("jaxbelt simulate --belt fast", "velocity of belt 'fast' must be a number, got 'fast'"),
    ("jaxbelt simulate --belt 1,law=conty", "law of belt .* got conty .did you mean 'conti'"),
    ("jaxbelt simulate --belt 0.3,load=-1", r"load of belt '0\.3,load=-1' must be >= 0, got -1\.0"),
    ("jaxbelt simulate --belt nan", "velocity of belt 'nan' must be finite, got nan"),
    (
        "jaxbelt simulate --belt 1,lower=2,upper=1",
        r"lower of belt .* must be < upper = 1\.0, got 2\.0",
    ),
    ("jaxbelt simulate --belt 1,quadratic=inf", "quadratic of belt .* must be finite, got inf"),
    (
        "jaxbelt simulate --belt 1,law=coulomb,static=0.5,kinetic=0.8",
        r"kinetic of belt .* must be <= static = 0\.5, got 0\.8",
    ),
    (
        "jaxbelt simulate --belt 1,law=stribeck,static=1,kinetic=0.5,stribeck_velocity=0",
        r"stribeck_velocity of belt .* must be > 0, got 0\.0",
    ),
    ("jaxbelt simulate --tolerance 1", r"tolerance must be > 0 and at most 0\.01, got 1\.0"),
    ("jaxbelt sweep nu0=0:1:9 --tolerance nan", "tolerance must be > 0 and at most .*, got nan"),
    ("jaxbelt simulate --formulation exact", "formulation must be .*, got exact"),
    ("jaxbelt simulate --out /dev/null/here/run", "out must be a place that can be .*here/run"),
    (
        "jaxbelt diagram --class c --vary sgma",
        "vary must be one of nu0, nu1, sigma, zeta, or .*, got sgma .did you mean 'sigma'",
    ),
    (
        "jaxbelt diagram --vary 'belts[0].friction.stepness'",
        r"vary must be one of nu0, nu1, zeta, or a path such as \S+ or \S+, got .*steepness'",
    ),
    ("jaxbelt diagram --vary sigma", "class b must have only nu0, nu1, got sigma"),
    ("jaxbelt orbits --class q", "class must be a, b, c or d, got q"),
    ("jaxbelt diagram --span 1 0", r"span must be FROM TO with FROM < TO, got 1\.0 0\.0"),
    ("jaxbelt diagram --quantity x3", "quantity must be one of .*, got x3"),
    ("jaxbelt map --axes nu0 nu0", "axes must be different ones, got nu0 twice"),
    ("jaxbelt map --axes nu0 zta", "axes must be one of nu0, .* got zta .did you mean 'zeta'"),
    ("jaxbelt map --cells 1", "cells must be at least 2, got 1"),
    ("jaxbelt basins --points 1", "points must be at least 2, got 1"),
    ("jaxbelt basins --points 1000000000", "points must be at most .* no memory for more results"),
    ("jaxbelt basins --x1 3 0", r"x1 must be FROM TO with FROM < TO, got 3\.0 0\.0"),
    ("jaxbelt sweep nu0", "an axis must be NAME=FROM:TO:COUNT or NAME=VALUE, got 'nu0'"),
    ("jaxbelt sweep nu0=1 'belts[0].velocity=2'", r"different ones, got belts\[0\].velocity twice"),
    ("jaxbelt sweep nu1=0:1:9 --belt 0.3", "axes must be one of .*nu0, zeta, .*, got nu1"),
    ("jaxbelt sweep nu0=0:1:9 --variable nope", "variable must be one of kind, .*, got nope"),
    ("jaxbelt sweep nu0=0:1:9 --observe atractor", "observe must be .* got atractor .did you mean"),
    ("jaxbelt sweep nu0=0:1:9 --out plane.csv", "out must end in .nc or .zarr, got plane.csv"),
    ("jaxbelt sweep nu0=0:1:9 --out p.zarr --blocks 4", "blocks must be FROM:TO, .*, got '4'"),
    ("jaxbelt sweep nu0=nan", "an axis must be NAME=FROM:TO:COUNT or NAME=VALUE, got 'nu0=nan'"),
    ("jaxbelt sweep nu0=0:inf:5", "an axis must be NAME=FROM:TO:COUNT or NAME=VALUE, got"),
    ("jaxbelt sweep --nuo 0.3", r"No such option:? '?--nuo'?.*nu0=\.\.\.'?, '?nu1=\.\.\."),
    ("jaxbelt diagram --nuo 0.3", r"No such option:? '?--nuo'?[^-]*--nu0'?, '?--nu1"),
    ("jaxbelt simulate -nu0 0.3", r"No such option:? '?-n'?.*--nu0"),
    ("jaxbelt basins --zeta 0.3", "No such option:? '?--zeta'?.*--damping"),
    ("jaxbelt verify nowhere.zarr", "store must be a folder that sweep wrote, got nowhere.zarr"),
    ("jaxbelt reproduce --out /dev/null", "out must be a folder, got the file /dev/null"),
]


# --- what the calls above are about ---------------------------------------------------------------


class FadingLaw(jb.AbstractFriction):
    """A law with a number that has to be given."""

    static: jax.Array
    rate: Any = None

    def mu(self, speed):
        return self.static / (1 + self.rate * speed)


class Worded(jb.AbstractFriction):
    """A law whose field is neither a number nor static."""

    static: jax.Array
    word: Any

    def mu(self, speed):
        return self.static + 0 * speed


class NumpyLaw(jb.AbstractFriction):
    static: float = 1.0

    def mu(self, speed):
        return np.exp(-speed)


class BranchingLaw(jb.AbstractFriction):
    static: float = 1.0

    def mu(self, speed):
        return 1.0 if speed < 0.1 else 0.5


class OwnLaw(jb.AbstractFriction):
    function: Callable = eqx.field(static=True)
    static: float = 1.0

    @property
    def mu(self):
        return self.function


class Foreign:
    """Such as a column of words of another library."""

    dtype = "string"

    def __array__(self, dtype=None, copy=None):
        return np.array(["a", "b"])


class Reducer:
    def init(self, osc, x1, x2):
        return x1

    def update(self, state, event):
        return state

    def finish(self, state, end):
        return state


class Numbered(Reducer):
    def finish(self, state, end):
        return {1: state}


class Named(Reducer):
    def __init__(self, name):
        self.name = name

    def finish(self, state, end):
        return {self.name: state}


class Made(Reducer):
    """A sum of x1 with other methods."""

    def __init__(self, **methods):
        self.__dict__.update(methods)

    def update(self, state, event):
        return state + event.x1

    def finish(self, state, end):
        return {"sum": state}


class Sectioned(Reducer):
    at = (jb.AtSection(lambda osc, x1, x2: x1 > 0),)


class Growing(Reducer):
    def update(self, state, event):
        return state, event.t


def keyed(name):
    """A maker whose argument has any name."""
    return lambda **given: jb.presets.class_a(given[name])


def with_float(nu0):
    return jb.presets.class_a(float(nu0))


def nu0(osc):
    return osc.belts[0].velocity


def nu1(osc):
    return osc.belts[1].velocity


def nu2(osc):
    return osc.belts[2].velocity


def both(osc):
    return osc.belts[0].velocity, osc.belts[1].velocity


def damped(osc):
    return osc.damping


def twice(osc):
    return osc.damping, osc.damping


def names() -> dict:
    """What stands in the calls."""
    osc, row = jb.presets.class_b(0.45, 0.35), np.linspace(0.0, 20.0, 200)
    law, one = jb.presets.paper_friction(), jb.presets.class_a(0.3)
    physical = jb.PhysicalBelt(0.1, law, 1.0)
    # Results without what they would be computed from.
    cycle = jb.Cycle(osc, *[None] * 5, jnp.asarray(0))
    point, failed = (
        jb.BifurcationPoint(
            jb.Hopf(), *[np.float64("nan")] * 7, osc, cycle, np.asarray(status.value)
        )
        for status in (jb.Status.OK, jb.Status.NO_CONVERGENCE)
    )
    return globals() | {
        "AXES": {"nu0": row, "nu1": row},
        "BOX": ((0, 3), (-1, 1)),
        "PLANE": ((-1, 1), (-1, 1)),
        "TARGET": [(jb.amplitude, 1.0)],
        "belt": jb.Belt(0.3, law),
        "cycle": cycle,
        "curve": jb.BifurcationCurve(*[None] * 9),
        "several": jb.Equilibria(*[None] * len(dataclasses.fields(jb.Equilibria))),
        "one": one,
        "of_one": jb.Cycle(one, *[None] * 5, jnp.asarray(0)),
        "run": jb.Trajectory(*[None] * 5, jnp.asarray(0)),
        "edged": jb.presets.class_c(0.1, 0.3, 0.2),
        "forced": jb.presets.di_bernardo(1.7),
        "dataset": xr.Dataset({"kind": ("nu0", [0])}),
        "failed": failed,
        "key": jax.random.key(0),
        "keys": jax.random.split(jax.random.key(0), 3),
        "law": law,
        "machine": jb.Machine(1.0, 1.0, 0.1, (physical,)),
        "physical": physical,
        "osc": osc,
        "point": point,
        "row": row,
    }


def called(what: str, known: dict) -> tuple[str, str]:
    """What kind of error comes, and its message."""
    if what.startswith("jaxbelt "):
        from jaxbelt.cli import app

        result = CliRunner().invoke(app, shlex.split(what)[1:])
        kind = "exit" if result.exit_code == 2 else repr(result.exception)
        # The boxes around messages about unknown options fold them.
        return kind, " ".join(result.stderr.replace("│", " ").split())
    try:
        eval(what, known)
    except Exception as error:
        return type(error).__name__, str(error)
    return "nothing", ""


def main() -> None:
    """Print a line for each mistake: what was called, what came, what was compiled, and seconds."""
    warnings.simplefilter("error")
    # What other packages have yet to change is no mistake.
    warnings.simplefilter("ignore", DeprecationWarning)
    warnings.filterwarnings("error", category=DeprecationWarning, module="jaxbelt")
    jax.config.update("jax_enable_x64", True)
    known = names()
    # What each process does once: tricks are tried before they are first used, Matplotlib imported.
    for what in ("jb.sweep(with_float, {'nu0': row}, t1=9.0)", "jb.plot_basins(osc)"):
        called(what, known)
    for what in ("jb.refine(jb.Hopf(), lambda v: v, at=0.3)", "jb.scan(osc, nu0, (1.0, -1.0))"):
        called(what, known)
    jax.block_until_ready(jnp.asarray(np.zeros(())))
    for what, _ in MISTAKES:
        began = time.perf_counter()
        with compilations() as compiled:
            kind, message = called(what, known)
        row = [what, kind, message, compiled, time.perf_counter() - began]
        print(json.dumps(row))


if __name__ == "__main__":
    sys.exit(main())
