from . import presets
from .friction import AbstractFriction, Conti, Coulomb, Stribeck
from .oscillator import Belt, Oscillator
from .results import EventKind, Status, describe
from .simulate import Events, Trajectory, simulate
