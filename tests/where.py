"""Numbers of an oscillator, as `where` takes them."""


def nu0(osc):
    return osc.belts[0].velocity


def nu1(osc):
    return osc.belts[1].velocity


def zeta(osc):
    return osc.damping
