"""Published parameter sets and published values, each with its reference.

The four classes of the double-belt oscillator of P. Casini and F. Vestroni, "Nonstandard
Bifurcations in Oscillators with Multiple Discontinuity Boundaries", Nonlinear Dynamics 35 (2004)
41-59, "the paper" throughout this package.

For class (a) the paper prints p3 = 3.0 (section 3.2). That is a misprint: only p3 = 10, which it
prints for class (b), gives its values and figures. With p3 = 3 the Hopf point of eq. (28) lies at
0.183064 and not at the printed 0.18284, and the fold at 0.215967 and not at the printed 0.26704.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike

from .checks import is_concrete, require
from .model.forcing import Harmonic
from .model.friction import Conti, Coulomb, Cubic
from .model.oscillator import Belt, Oscillator

DAMPING = 0.5


def paper_friction() -> Conti:
    """Friction of every belt of the paper: mus = 1, p1 = 0.6, p2 = 0 and p3 = 10 (dimensionless).

    p3 = 10 for class (a) too, where the paper prints 3.0 by mistake; see the module's text.
    """
    return Conti(static=1.0, residual=0.6, steepness=10.0)


def class_a(nu0: ArrayLike) -> Oscillator:
    """One belt, always touching: the paper's class (a).

    Eqs. (2)-(4) and section 3.2 of the paper, with zeta = 0.5, mus = 1, p1 = 0.6, p2 = 0 and p3 =
    10. The 3.0 that the paper prints for p3 in this class is a misprint: only p3 = 10 gives its
    values and figures.

    Args:
        nu0: Belt velocity, dimensionless scalar.

    Returns:
        The `Oscillator`.
    """
    return Oscillator(DAMPING, (Belt(nu0, paper_friction()),))


def class_b(nu0: ArrayLike, nu1: ArrayLike) -> Oscillator:
    """Two belts, both always touching: the paper's class (b).

    Eqs. (11)-(14) and section 3.3 of the paper, with zeta = 0.5, mus = 1, p1 = 0.6, p2 = 0 and p3 =
    10.

    Args:
        nu0: Velocity of belt 0, dimensionless scalar.
        nu1: Velocity of belt 1, likewise.

    Returns:
        The `Oscillator`.
    """
    return Oscillator(DAMPING, (Belt(nu0, paper_friction()), Belt(nu1, paper_friction())))


def class_c(nu0: ArrayLike, nu1: ArrayLike, sigma: ArrayLike) -> Oscillator:
    """One belt at a time: belt 0 touches while x1 < sigma, belt 1 while x1 > sigma; class (c).

    The paper defines the class (section 2.2, Fig. 2c) and leaves it to further research; the other
    constants are those of class (b).

    Args:
        nu0: Velocity of belt 0, dimensionless scalar.
        nu1: Velocity of belt 1, likewise.
        sigma: Edge between the belts, likewise.

    Returns:
        The `Oscillator`.
    """
    return class_d(nu0, nu1, sigma, sigma)


def class_d(nu0: ArrayLike, nu1: ArrayLike, sigma0: ArrayLike, sigma1: ArrayLike) -> Oscillator:
    """Overlapping contact: belt 0 touches while x1 < sigma1, belt 1 while x1 > sigma0; class (d).

    Between sigma0 and sigma1 both touch. The paper defines the class (section 2.2, Fig. 2d) and
    leaves it to further research; the other constants are those of class (b).

    Args:
        nu0: Velocity of belt 0, dimensionless scalar.
        nu1: Velocity of belt 1, likewise.
        sigma0: Edge from which belt 1 touches, likewise.
        sigma1: Edge up to which belt 0 touches, likewise; sigma0 <= sigma1.

    Returns:
        The `Oscillator`.

    Raises:
        ValueError: If sigma0 > sigma1.
    """
    if is_concrete((sigma0, sigma1)):
        require(
            np.all(np.asarray(sigma0) <= np.asarray(sigma1)),
            "sigma0",
            f"<= sigma1 = {sigma1}",
            sigma0,
        )
    belts = (
        Belt(nu0, paper_friction(), upper=sigma1),
        Belt(nu1, paper_friction(), lower=sigma0),
    )
    return Oscillator(DAMPING, belts)


def den_hartog(
    frequency: ArrayLike,
    amplitude: ArrayLike = 1.0,
    friction: ArrayLike = 0.4,
    damping: ArrayLike = 0.05,
) -> Oscillator:
    """Den Hartog's oscillator: a forced mass on a surface at rest, with Coulomb's friction.

    x'' + damping x' + x = amplitude cos(frequency tau) - friction sgn(x'). See J. P. Den Hartog,
    Forced vibrations with combined Coulomb and viscous friction, Trans. ASME 53 (1931) APM-107.

    Args:
        frequency: Angular frequency of the force in the time tau, where that of the mass is 1.
        amplitude: Of the force, over the stiffness.
        friction: Friction force over the stiffness, static and kinetic.
        damping: c / sqrt(k m).

    Returns:
        The oscillator: one belt of velocity 0.

    Example:
        osc = jb.presets.den_hartog(frequency=0.5)
    """
    belt = Belt(0.0, Coulomb(static=1.0, kinetic=1.0), load=friction)
    return Oscillator(damping, (belt,), forcing=Harmonic(amplitude, frequency))


def di_bernardo(frequency: ArrayLike, amplitude: ArrayLike = 0.1) -> Oscillator:
    """The oscillator of di Bernardo, Kowalczyk and Nordmark, with its route to chaos by sliding.

    y'' + y = f(1 - y') + amplitude cos(frequency tau), f(r) = 1.5 sgn r - 1.5 r + 0.45 r^3: without
    damping, on a belt of velocity 1 with a cubic law. See M. di Bernardo, P. Kowalczyk and A.
    Nordmark, Sliding bifurcations: a novel mechanism for the sudden onset of chaos in dry friction
    oscillators, Int. J. Bifurcation Chaos 13 (2003) 2935-2948.

    Args:
        frequency: Angular frequency of the force in the time tau; around 1.7 in the paper.
        amplitude: Of the force, over the stiffness.

    Returns:
        The oscillator.

    Example:
        osc = jb.presets.di_bernardo(frequency=1.7077)
    """
    belt = Belt(1.0, Cubic(a0=1.5, a1=1.5, a3=0.45))
    return Oscillator(0.0, (belt,), forcing=Harmonic(amplitude, frequency))


class PublishedValue(NamedTuple):
    """A critical belt velocity nu0 as the paper prints it, with the paper's name for it."""

    system: str
    point: str
    kind: str
    printed: float


#: Critical values of sections 3.2 (class a) and 3.3 (class b with nu1 = 0.35) of the paper.
PUBLISHED = (
    PublishedValue("a", "nu_alpha", "nonsmooth fold", 0.26704),
    PublishedValue("a", "nu_beta", "Hopf, subcritical", 0.18284),
    PublishedValue("b", "nu_alpha", "nonsmooth fold on belt 1", 0.53822),
    PublishedValue("b", "nu_beta", "sliding exchange", 0.35),
    PublishedValue("b", "nu_gamma", "Hopf, subcritical", 0.26365),
    PublishedValue("b", "nu_delta", "sudden sliding appearance", 0.0),
    PublishedValue("b", "nu_epsilon", "Hopf, subcritical", -0.26365),
    PublishedValue("b", "nu_zeta", "sliding on belt 0 (grazing)", -0.4558),
    PublishedValue("b", "nu_eta", "nonsmooth fold on belt 1", -0.56050),
)

#: Velocity of belt 1 in the paper's class (b) diagrams, Figs. 7-13.
PUBLISHED_NU1 = 0.35
