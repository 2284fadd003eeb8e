"""How long diagrams and curves take: `pytest tests/benchmarks --benchmark-only`. Asserts no time.

Everything is warm: what is compiled is compiled before.
"""

import shutil
import subprocess

import numpy as np
import pytest

import jaxbelt as jb
from tests.where import nu0, nu1


@pytest.fixture(scope="module")
def points():
    return jb.scan(jb.presets.class_b(0.3, 0.35), nu0, (-0.7, 0.7))


def test_scan_of_the_papers_path(benchmark, points):
    """Eight points, without a guess."""
    found = benchmark.pedantic(
        lambda: jb.scan(jb.presets.class_b(0.3, 0.35), nu0, (-0.7, 0.7)),
        warmup_rounds=1,
        rounds=3,
    )
    assert len(found) == len(points) == 8


def test_diagram_of_fig07(benchmark):
    """Points, equilibria, stable and unstable cycles."""
    found = benchmark.pedantic(
        lambda: jb.bifurcation_diagram(jb.presets.class_b(0.3, 0.35), nu0, (-0.7, 0.7)),
        warmup_rounds=1,
        rounds=3,
    )
    assert len(found.branches) == 4


def test_curve_of_200_points(benchmark, points):
    """The fold on belt 1 in the plane of both velocities, without its corner."""
    span = ((-0.7, -0.53), (0.3, 0.36))

    def curve():
        return jb.bifurcation_curve(points[0], (nu0, nu1), span, step=8.7e-4)

    found = benchmark.pedantic(curve, warmup_rounds=1, rounds=3)
    assert 190 <= len(found) <= 230 and np.max(found.residual) < 1e-12


#: Class (b) with nu1 = 0.35, near its fixed point: what touches no boundary.
AUTO_EQUATIONS = """
SUBROUTINE FUNC(NDIM,U,ICP,PAR,IJAC,F,DFDU,DFDP)
  IMPLICIT NONE
  INTEGER, INTENT(IN) :: NDIM, ICP(*), IJAC
  DOUBLE PRECISION, INTENT(IN) :: U(NDIM), PAR(*)
  DOUBLE PRECISION, INTENT(OUT) :: F(NDIM)
  DOUBLE PRECISION, INTENT(INOUT) :: DFDU(NDIM,NDIM), DFDP(NDIM,*)
  F(1)=U(2)
  F(2)=-U(1)-0.5D0*U(2)+1.2D0+0.4D0/(1D0+10D0*(PAR(1)-U(2)))+0.4D0/(1D0+10D0*(0.35D0-U(2)))
END SUBROUTINE FUNC
SUBROUTINE STPNT(NDIM,U,PAR,T)
  IMPLICIT NONE
  INTEGER, INTENT(IN) :: NDIM
  DOUBLE PRECISION, INTENT(INOUT) :: U(NDIM),PAR(*)
  DOUBLE PRECISION, INTENT(IN) :: T
  PAR(1)=0.2D0
  U(1)=1.2D0+0.4D0/3D0+0.4D0/4.5D0
  U(2)=0D0
END SUBROUTINE STPNT
SUBROUTINE BCND
END SUBROUTINE BCND
SUBROUTINE ICND
END SUBROUTINE ICND
SUBROUTINE FOPT
END SUBROUTINE FOPT
SUBROUTINE PVLS(NDIM,U,PAR)
  IMPLICIT NONE
  INTEGER, INTENT(IN) :: NDIM
  DOUBLE PRECISION, INTENT(IN) :: U(NDIM)
  DOUBLE PRECISION, INTENT(INOUT) :: PAR(*)
  DOUBLE PRECISION, EXTERNAL :: GETP
  PAR(12)=GETP('MAX',1,U)
  PAR(13)=GETP('MIN',1,U)
END SUBROUTINE PVLS
"""

AUTO_CONSTANTS = """
NDIM= 2, IPS = 1, IRS = 0, ILP = 0
ICP = [1, 11]
NTST=400, NCOL=4, IAD=3, ISP=2, ISW=1, IPLT=0, NBC=0, NINT=0
NMX=200, NPR=200, MXBF=0, IID=2, ITMX=8, ITNW=7, NWTN=3, JAC=0
EPSL=1e-10, EPSU=1e-10, EPSS=1e-8
DS=0.01, DSMIN=1e-6, DSMAX=0.02, IADS=1
NPAR=13, THL={11:0.0}, THU={}
UZSTOP={1:0.5}
"""

AUTO_SCRIPT = """
rests = run('belts')
hopf = rests('HB1')
cycles = run(hopf, IPS=2, ICP=[1, 11, 12, 13], NMX=300, DS=0.01, DSMAX=0.02, UZSTOP={1: 0.5})
save(cycles, 'cycles')
"""


def test_auto(benchmark, tmp_path):
    """AUTO-07p: the unstable cycle from its Hopf point to nu0 = 0.5, beside `test_unstable_cycles`.

    With its start and the compiling and linking of the equations, as a user has it; of itself it
    tells a time of 0.2 (NTST = 100) to 0.9 s.
    """
    if shutil.which("auto-07p") is None or shutil.which("gfortran") is None:
        pytest.skip("AUTO-07p or gfortran is not installed")
    (tmp_path / "belts.f90").write_text(AUTO_EQUATIONS)
    (tmp_path / "c.belts").write_text(AUTO_CONSTANTS)
    (tmp_path / "run.py").write_text(AUTO_SCRIPT)

    def auto():
        subprocess.run(["auto-07p", "run.py"], cwd=tmp_path, check=True, capture_output=True)

    benchmark.pedantic(auto, rounds=2)
    lines = (line.split() for line in (tmp_path / "b.cycles").read_text().splitlines())
    rows = np.array([[float(x) for x in line[4:]] for line in lines if line and line[0] == "-2"])
    for nu, _, _, _, period, x1_max, x1_min in rows[1:]:
        cycle = jb.unstable_cycle(jb.presets.class_b(nu, 0.35))
        assert cycle.period == pytest.approx(period, rel=1e-9)
        # It knows the extrema at the points of its mesh.
        assert cycle.x1_max - cycle.x1_min == pytest.approx(x1_max - x1_min, abs=2e-6)


def test_unstable_cycles(benchmark):
    """The same branch, 28 values, each found without a guess."""
    values = np.linspace(0.27, 0.5, 28)

    def branch():
        return [jb.unstable_cycle(jb.presets.class_b(nu, 0.35)).period for nu in values]

    assert np.all(np.isfinite(benchmark.pedantic(branch, warmup_rounds=1, rounds=3)))
