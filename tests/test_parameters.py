"""Which parameter `where` selects: a leaf by its place, or a clear error, in every entry."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from laws import Lorentz

import jaxbelt as jb
from jaxbelt.model.parameters import leaf_groups, leaf_index, names_of, vary
from notebooks.switch_folds import switch_band, switch_fold

OSC = jb.presets.class_b(nu0=0.3, nu1=0.35)


def velocity(osc):
    return osc.belts[0].velocity


# --- what is a parameter --------------------------------------------------------------------------


NO_PARAMETER = {
    "twice it": (lambda o: 2 * velocity(o), "TypeError"),
    "one more": (lambda o: velocity(o) + 1, "TypeError"),
    "one less, from the left": (lambda o: 1.0 - velocity(o), "TypeError"),
    "its negative": (lambda o: -velocity(o), "TypeError"),
    "its square": (lambda o: velocity(o) ** 2, "TypeError"),
    "its sine": (lambda o: jnp.sin(velocity(o)), "TypeError"),
    "its sine in NumPy": (lambda o: np.sin(velocity(o)), "TypeError"),
    "its number": (lambda o: float(velocity(o)), "TypeError"),
    "an array of it": (lambda o: np.asarray(velocity(o)), r"array\(belts\[0\].velocity"),
    "a friction coefficient": (lambda o: o.belts[0].friction.mu(0.1), "Type.*Error"),
    "by its value": (lambda o: o.omega if velocity(o) == 0.3 else o.damping, "TypeError"),
    "the last of two": (lambda o: velocity(o) and o.damping, "TypeError"),
    "a number": (lambda o: 2, "got 2$"),
    "a leaf of another": (lambda o: velocity(OSC), r"got Array\(0.3"),
    "nothing": (lambda o: None, "got None$"),
    "a tuple": (lambda o: (o.damping, o.omega), r"got \(damping, omega\)$"),
    "a tuple of one": (lambda o: (o.damping,), r"got \(damping\)$"),
    "a belt": (lambda o: o.belts[0], "got a whole Belt$"),
    "a friction law": (lambda o: o.belts[0].friction, "got a whole Conti$"),
    "all belts": (lambda o: o.belts, r"got \(a whole Belt, a whole Belt\)$"),
    "a belt that is not there": (lambda o: o.belts[2].velocity, "one of a belt that is not there"),
    "a name that is not there": (lambda o: o.velocity, "AttributeError: .*velocity"),
    "a name": ("nu0", "got 'nu0'$"),
    "a function of nothing": (lambda: 0, "TypeError"),
}


@pytest.mark.parametrize("where, came", NO_PARAMETER.values(), ids=NO_PARAMETER.keys())
def test_what_is_no_parameter_is_told(where, came):
    expected = "^where must be a function that selects one parameter .*belts 0 to 1.*"
    with pytest.raises(ValueError, match=expected + came):
        leaf_index(OSC, where)


def test_a_parameter_is_a_leaf_by_its_place():
    # All of them the same objects, Python's small integers and floats among them.
    number, law = jnp.asarray(1.0), Lorentz(1, 1, 1.0)
    belt = jb.Belt(velocity=number, friction=law, load=number)
    osc = jb.Oscillator(damping=number, belts=(belt, belt), omega=number)
    wheres = {
        "damping": lambda o: o.damping,
        "belts[0].velocity": lambda o: o.belts[0].velocity,
        "belts[0].friction.static": lambda o: o.belts[0].friction.static,
        "belts[0].friction.kinetic": lambda o: o.belts[0].friction.kinetic,
        "belts[0].friction.velocity": lambda o: o.belts[0].friction.velocity,
        "belts[0].load": lambda o: o.belts[0].load,
        "belts[0].lower": lambda o: o.belts[0].lower,
        "belts[0].upper": lambda o: o.belts[0].upper,
        "belts[1].velocity": lambda o: o.belts[1].velocity,
        "belts[1].friction.static": lambda o: o.belts[1].friction.static,
        "belts[1].friction.kinetic": lambda o: o.belts[-1].friction.kinetic,
        "belts[1].friction.velocity": lambda o: o.belts[1].friction.velocity,
        "belts[1].load": lambda o: o.belts[1].load,
        "belts[1].lower": lambda o: o.belts[1].lower,
        "belts[1].upper": lambda o: o.belts[1].upper,
        "omega": lambda o: o.omega,
    }
    assert names_of(osc) == list(wheres)
    for place, where in enumerate(wheres.values()):
        index = leaf_index(osc, where)
        assert index == place
        changed = jax.tree.leaves(vary(osc, index, jnp.asarray([7.0])))
        assert [i for i, leaf in enumerate(changed) if leaf == 7.0] == [place]
    assert leaf_groups(osc, lambda o: tuple(where(o) for where in wheres.values())) == tuple(
        (place,) for place in range(len(wheres))
    )


class _Named(jb.AbstractFriction):
    """A law with a leaf that is no number."""

    static: jax.Array
    name: object

    def mu(self, speed):
        return self.static


def test_a_leaf_that_is_no_number_is_no_parameter():
    law = _Named(jnp.asarray(1.0), name=True)
    osc = jb.Oscillator(0.5, (jb.Belt(0.3, law),))
    assert leaf_index(osc, lambda o: o.belts[0].friction.static) == 2
    with pytest.raises(ValueError, match=r"got belts\[0\].friction.name$"):
        leaf_index(osc, lambda o: o.belts[0].friction.name)


def test_several_parameters():
    def friction(osc, belt):
        return osc.belts[belt].friction.static

    assert leaf_groups(OSC, velocity) == ((1,),)
    tied = leaf_groups(OSC, lambda o: (o.damping, (friction(o, 0), friction(o, 1))))
    assert tied == ((0,), (2, 10))
    for where, came in [
        (lambda o: (o.damping, -velocity(o)), "TypeError"),
        (lambda o: (o.damping, (velocity(o), 2 * velocity(o))), "TypeError"),
        (lambda o: (o.damping, 3), r"got \(damping, 3\)$"),
        (lambda o: (o.damping, ()), r"got \(damping, \(\)\)$"),
        (lambda o: (), r"got \(\)$"),
        (lambda o: o.belts, "a whole Belt"),
        (lambda o: (o.damping, o.belts[2].load), "one of a belt that is not there"),
        ("damping", "got 'damping'$"),
    ]:
        with pytest.raises(ValueError, match=r"^where must be a function that selects .*" + came):
            leaf_groups(OSC, where)
    with pytest.raises(ValueError, match=r"^where must be free of repeats, got \(omega, omega\)$"):
        leaf_groups(OSC, lambda o: (o.omega, o.omega))


# --- in every entry -------------------------------------------------------------------------------


def double(osc):
    return 2 * velocity(osc)


ENTRIES = {
    "refine": lambda point: jb.refine(jb.Hopf(), OSC, where=double),
    "scan": lambda point: jb.scan(OSC, where=double, span=(0.1, 0.2)),
    "diagram": lambda point: jb.bifurcation_diagram(OSC, where=double, span=(0.1, 0.2)),
    "curve": lambda point: jb.bifurcation_curve(
        point, where=(lambda osc: osc.damping, double), span=((0.0, 1.0), (0.0, 1.0))
    ),
    "fit": lambda point: jb.fit(
        OSC, np.arange(9.0), np.arange(9.0), where=lambda osc: (osc.damping, double(osc))
    ),
    "design": lambda point: jb.design(OSC, [(jb.amplitude, 1.0)], where=double),
    "switch fold": lambda point: switch_fold(point, 1e-4, where=double),
    "switch band": lambda point: switch_band(point, 0.53, where=double),
}


@pytest.fixture(scope="module")
def fold():
    osc = jb.presets.class_b(nu0=0.538, nu1=0.35)
    return jb.refine(jb.NonsmoothFold(belt=1), osc, where=velocity)


@pytest.mark.parametrize("entry", ENTRIES.values(), ids=ENTRIES.keys())
def test_every_entry_refuses_before_it_computes(entry, fold):
    begin = time.process_time()
    with pytest.raises(ValueError, match=r"^where must be "):
        entry(fold)
    assert time.process_time() - begin < 1.0  # much less than compiling takes


@pytest.mark.slow(first=True)
def test_the_distance_to_a_point_is_that_of_the_parameter():
    cycle = jb.find_cycle(OSC, (3.0, 0.0))
    distance = jb.distance_to(jb.Hopf(), where=velocity)(cycle)
    assert distance == pytest.approx(0.3 - 0.263654916039, abs=1e-11)
    with pytest.raises(ValueError, match=r"^where must be "):
        jb.distance_to(jb.Hopf(), where=double)(cycle)
