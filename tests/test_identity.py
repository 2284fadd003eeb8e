"""Fingerprints: what changes them, what does not, and what cannot be told."""

import collections
import dataclasses
import enum
import functools
import math
import os
import re
import subprocess
import sys
import threading
import types
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbelt as jb
from jaxbelt.identity import FingerprintError, fingerprint

LIMIT = 0.5
SETTINGS = {"limit": 0.5}


def helper(x):
    return jnp.where(x > LIMIT, x, 0.0)


def calls(x):
    return 2 * helper(x)


def recursive(n):
    return 1 if n < LIMIT else n * recursive(n - 1)


def ping(n):
    return pong(n - LIMIT)


def pong(n):
    return ping(n) if n > 0 else n


def deep(x):
    def inner():
        return [LIMIT for _ in range(3)]

    return inner()


class Counts:
    limit = 3.0

    def __init__(self, unit):
        self.unit = unit

    def update(self, x):
        return helper(x) / self.unit

    @property
    def twice(self):
        return 2 * LIMIT

    @staticmethod
    def still(x):
        return x + LIMIT

    @functools.cached_property
    def costly(self):
        return LIMIT + self.unit


class Inherits(Counts):
    pass


@dataclasses.dataclass(frozen=True)
class Data:
    unit: float
    others: tuple = ()
    grown: list = dataclasses.field(default_factory=list)


class Law(jb.AbstractFriction):
    static: Any
    word: str = eqx.field(static=True, default="soft")

    def mu(self, speed):
        return self.static * calls(speed)


class Plane(eqx.Module):
    height: float

    def at(self, x1, x2):
        return x1 - self.height


class Wrapper:
    def __init__(self, function):
        functools.update_wrapper(self, function)

    def __call__(self, x):
        return vars(self)["__wrapped__"](x)


def with_call(decorate, factor):
    class Calls:
        @decorate
        def __call__(self, x):
            return factor * x

    return Calls()


class Colour(enum.Enum):
    RED = 1


@jax.custom_jvp
def bent(x):
    return helper(x)


bent.defjvp(lambda primals, tangents: (bent(*primals), tangents[0] * LIMIT))

READERS = {
    "function": lambda: helper,
    "one it calls": lambda: calls,
    "recursive": lambda: recursive,
    "two that call each other": lambda: ping,
    "function in a function": lambda: deep,
    "lambda": lambda: lambda x: helper(x),
    "method": lambda: Counts(2.0).update,
    "object": lambda: Counts(2.0),
    "object of a subclass": lambda: Inherits(2.0),
    "class": lambda: Counts,
    "module of Equinox": lambda: Law(jnp.ones(3)),
    "partial": lambda: functools.partial(helper, x=1.0),
    "jit": lambda: jax.jit(helper),
    "vmap": lambda: jax.vmap(helper),
    "grad": lambda: jax.grad(helper),
    "jit of vmap": lambda: jax.jit(jax.vmap(calls)),
    "filter_jit": lambda: eqx.filter_jit(helper),
    "cached": lambda: functools.lru_cache(helper),
    "custom derivative": lambda: bent,
    "container": lambda: {"a": [1.0, (helper,)]},
    "section": lambda: jb.AtSection(helper, 1),
    "tree definition": lambda: jax.tree.structure(eqx.filter(Law(1.0), False)),
}


@pytest.mark.parametrize("reader", READERS)
def test_what_reads_a_global_changes_with_it(reader, monkeypatch):
    before = fingerprint(READERS[reader]())
    assert fingerprint(READERS[reader]()) == before and re.fullmatch("[0-9a-f]{32}", before)
    monkeypatch.setitem(globals(), "LIMIT", 0.75)
    assert fingerprint(READERS[reader]()) != before
    monkeypatch.undo()
    assert fingerprint(READERS[reader]()) == before


def closes_over(value):
    return lambda x: x + value


def has_default(value):
    def function(x, y=value, *, z=value):
        return x + y + z

    return function


def has_attribute(value):
    def function(x):
        return x

    vars(function)["value"] = value
    return function


VALUES = {
    "numbers": (1.0, 2.0),
    "number and integer": (1.0, 1),
    "zeros": (0.0, -0.0),
    "integer and truth": (1, True),
    "texts": ("a", "b"),
    "text and bytes": ("a", b"a"),
    "arrays": (np.arange(3), np.arange(1, 4)),
    "shapes": (np.zeros((2, 3)), np.zeros((3, 2))),
    "dtypes": (np.zeros(2), np.zeros(2, "f4")),
    "jax": (jnp.arange(3.0), jnp.arange(3.0) + 1e-15),
    "keys": (jax.random.key(1), jax.random.key(2)),
    "objects": (np.array([1, "a"], object), np.array([1, "b"], object)),
    "lambdas": (lambda x: x, lambda x: -x),
    "constants": (lambda x: x + 1, lambda x: x + 2),
    "names": (jnp.sin, jnp.cos),
    "built in": (math.sin, math.cos),
    "ufuncs": (np.sin, np.cos),
    "members": (lambda x: x in {1, 2}, lambda x: x in {1, 3}),
    "instances": (Counts(1.0), Counts(2.0)),
    "dataclasses": (Data(1.0), Data(1.0, (2,))),
    "modules": (Law(1.0), Law(1.0, word="hard")),
    "partials": (functools.partial(max, 1), functools.partial(max, 2)),
    "dictionaries": ({"a": 1}, {"b": 1}),
    "nested": ([1, [2]], [[1], 2]),
    "named tuples": (collections.namedtuple("A", "x")(1), (1,)),
    "enumerations": (Colour.RED, 1),
    "vmap": (jax.vmap(helper), jax.vmap(helper, in_axes=1)),
    "orders": (jax.grad(helper), jax.value_and_grad(helper)),
    "patterns": (re.compile("a"), re.compile("b")),
    "namespaces": (types.SimpleNamespace(a=1), types.SimpleNamespace(a=2)),
    "laws": (jb.Conti(1.0, 0.6, 10.0), jb.Coulomb(1.0, 0.6)),
    "packages": (np, jnp),
    "methods": (Counts(1.0).update, Counts(2.0).update),
    "methods of modules": (Plane(1.0).at, Plane(2.0).at),
    "wrappers": (Wrapper(lambda x: x), Wrapper(lambda x: -x)),
    "calls": (with_call(lambda f: f, 1), with_call(lambda f: f, 2)),
    "calls by JAX": (with_call(jax.jit, 1), with_call(jax.jit, 2)),
    "calls by Equinox": (with_call(eqx.filter_jit, 1), with_call(eqx.filter_jit, 2)),
    "calls that are kept": (with_call(functools.cache, 1), with_call(functools.cache, 2)),
}


@pytest.mark.parametrize("hold", [lambda value: value, closes_over, has_default, has_attribute])
@pytest.mark.parametrize("pair", VALUES)
def test_what_differs_has_another_fingerprint(pair, hold):
    one, other = VALUES[pair]
    assert fingerprint(hold(one)) == fingerprint(hold(one)) != fingerprint(hold(other))


def test_what_is_the_same_has_the_same_fingerprint():
    def named_otherwise(x):
        return jnp.where(x > LIMIT, x, 0.0)

    assert fingerprint(named_otherwise) == fingerprint(helper)
    assert fingerprint(lambda x: x + LIMIT) == fingerprint(lambda x: x + LIMIT)
    assert fingerprint(np.arange(6).reshape(2, 3).T) == fingerprint(
        np.ascontiguousarray(np.arange(6).reshape(2, 3).T)
    )
    assert fingerprint({"b", "a"}) == fingerprint({"a", "b"})
    used = Counts(2.0)
    assert used.costly and fingerprint(used) == fingerprint(Counts(2.0))
    compiled = jax.jit(helper)
    before = fingerprint(compiled)
    compiled(1.0)
    assert fingerprint(compiled) == before


def test_a_module_of_ones_own_counts_by_what_is_read_of_it(monkeypatch):
    own = types.ModuleType("own_numbers")
    own.used, own.unused, own.part = 1.0, 1.0, types.ModuleType("own_numbers.part")
    own.part.deep = 1.0
    monkeypatch.setitem(globals(), "own", own)

    def reads(x):
        return x + globals_own() + own.used + own.part.deep

    def globals_own():
        return own.used

    before = fingerprint(reads)
    own.unused = 2.0
    assert fingerprint(reads) == before
    own.part.deep = 2.0
    assert fingerprint(reads) != before
    own.part.deep, own.used = 1.0, 2.0
    assert fingerprint(reads) != before


def generator():
    yield 1


GENERATOR, LOCK = generator(), threading.Lock()


UNTOLD = {
    "generator": (lambda: lambda: next(GENERATOR), r"GENERATOR of .*<lambda>.* a generator"),
    "lock": (lambda: types.SimpleNamespace(lock=LOCK), "SimpleNamespace: lock: .* a lock"),
    "evaluated": (lambda: lambda: eval("1"), "eval, which may read anything"),
    "all globals": (lambda: lambda: globals()["LIMIT"], "globals, which may read anything"),
    "all modules": (lambda: lambda: sys.modules["own"].C, "sys.modules, which may read anything"),
    "file": (lambda: lambda: open("a.txt"), "open, which may read anything"),
    "module": (lambda: closes_over(sys.modules[__name__]), "the module value as a value"),
    "module in an object": (
        lambda: types.SimpleNamespace(m=sys.modules[__name__]),
        "the module .*test_identity as a value: name what is read of it",
    ),
}


@pytest.mark.parametrize("case", UNTOLD)
def test_what_cannot_be_told_is_refused(case):
    make, message = UNTOLD[case]
    with pytest.raises(FingerprintError, match=f"must be made of numbers, .*{message}"):
        fingerprint(make())


def test_what_is_traced_is_refused():
    def traced(x):
        with pytest.raises(FingerprintError, match="got a traced array"):
            fingerprint(x)
        with pytest.raises(FingerprintError, match=r"got in value of .* a traced array"):
            fingerprint(closes_over(x))
        return x

    jax.jit(traced)(1.0)


def test_an_import_in_a_function_of_ones_own_code_is_refused():
    def imports_package():
        import numpy.linalg as linalg

        return linalg.norm

    def imports_own():
        import laws

        return laws

    assert fingerprint(imports_package)
    with pytest.raises(FingerprintError, match="an import of laws: do it outside"):
        fingerprint(imports_own)


@pytest.mark.slow(first=True)
def test_it_is_the_same_in_another_process():
    told = {name: fingerprint(make()) for name, make in READERS.items()}
    told |= {f"value {name}": fingerprint(pair[0]) for name, pair in VALUES.items()}
    code = (
        "import jax; jax.config.update('jax_enable_x64', True)\n"
        "import test_identity as t\n"
        "for name, make in t.READERS.items(): print(t.fingerprint(make()))\n"
        "for pair in t.VALUES.values(): print(t.fingerprint(pair[0]))\n"
    )
    for seed in "1", "2":
        environment = dict(
            os.environ,
            PYTHONHASHSEED=seed,
            PYTHONPATH=os.pathsep.join([os.path.dirname(__file__), *sys.path]),
        )
        ran = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, env=environment
        )
        assert ran.returncode == 0, ran.stderr
        there = dict(zip(told, ran.stdout.split(), strict=True))
        assert there == told
