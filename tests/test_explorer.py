"""The live explorer: its sliders are the numbers of an oscillator, and moving one redraws."""

import numpy as np
import pytest

import jaxbelt as jb


@pytest.mark.slow(first=True)
def test_sliders_move_the_oscillator_and_the_picture():
    explorer = jb.explore(jb.presets.class_d(0.45, 0.35, -0.5, 0.6), t1=20.0)
    assert {"damping", "belts[0].velocity", "belts[1].lower", "x1"} <= explorer.sliders.keys()
    assert "belts[0].lower" not in explorer.sliders  # it is unbounded there
    png, message = explorer.widget.children[1].children
    before = bytes(png.value)
    assert before.startswith(b"\x89PNG") and message.value.startswith("OK")
    explorer.sliders["belts[0].velocity"].value = -0.2
    assert bytes(png.value) != before
    assert float(explorer.oscillator.belts[0].velocity) == -0.2
    assert float(explorer.oscillator.belts[1].velocity) == 0.35
    before = bytes(png.value)
    # What cannot be is told, and the picture stays.
    explorer.sliders["belts[0].load"].min = -1.0
    explorer.sliders["belts[0].load"].value = -0.5
    assert message.value == "load of belt 0 must be >= 0, got -0.5"
    assert bytes(png.value) == before
    explorer.sliders["belts[0].load"].value = 1.0
    explorer.sliders["x1"].value = 2.5
    portrait = explorer.figure.axes[0]
    # Entries of the key are lines without data.
    begins = [line.get_xdata()[0] for line in portrait.lines if len(line.get_xdata())]
    assert max(begins) == 2.5


@pytest.mark.slow(first=True)
def test_a_machine_is_explored_in_its_units():
    law = jb.Tabulated([0.0, 0.01, 0.02, 0.05], [0.8, 0.6, 0.5, 0.45])
    belts = (
        jb.PhysicalBelt(0.02, law, 5.0),
        jb.PhysicalBelt(-0.03, jb.Conti(0.4, 0.25, 100.0), 3.0),
    )
    machine = jb.Machine(0.5, 2000.0, 1.0, belts)
    explorer = jb.explore(machine, t1=1.0)
    assert {"mass", "stiffness", "belts[0].normal_force", "x1"} <= explorer.sliders.keys()
    assert repr(explorer.oscillator) == repr(machine.oscillator)
    for _ in range(2):  # also when they are drawn anew
        labels = [(ax.get_xlabel(), ax.get_ylabel()) for ax in explorer.figure.axes]
        assert ("displacement $X$ (m)", r"velocity $\dot X$ (m/s)") in labels
        assert ("relative velocity $R$ (m/s)", r"$\mu\,\mathrm{sgn}\,R$") in labels
        assert explorer.figure.axes[-1].get_xlim()[1] == pytest.approx(1.0)
        explorer.sliders["belts[0].velocity"].value = 0.03
    assert float(explorer.shown.belts[0].velocity) == 0.03
    assert explorer.message.value.startswith("OK")
    # The unit of a law's speeds is no number of the machine.
    names = jb.explore(machine.oscillator, t1=1.0).sliders
    assert not [name for name in names if name.endswith("unit")]


def three_belts():
    velocities = np.linspace(0.0, 3.0, 13)
    measured = jb.Tabulated(velocities, 0.6 + 0.4 / (1 + 5 * velocities))
    belts = (
        jb.Belt(0.4, measured, upper=1.0),
        jb.Belt(-0.2, jb.Stribeck(1.0, 0.6, 0.2)),
        jb.Belt(0.4, jb.Conti(1.0, 0.6, 10.0), load=0.0),
    )
    return jb.Oscillator(0.2, belts)


@pytest.mark.slow
@pytest.mark.parametrize(
    "osc",
    [
        jb.presets.class_a(0.25),
        jb.presets.class_c(-0.3, 0.3, sigma=0.2),
        jb.Oscillator(0.0, (jb.Belt(0.0, jb.Coulomb(0.5, 0.25)),)),
        three_belts(),
    ],
    ids=["a", "c", "Coulomb", "three"],
)
def test_every_slider_goes_to_both_of_its_ends(osc):
    """Each draws a picture, or says which number cannot be."""
    explorer = jb.explore(osc, t1=20.0)
    png, message = explorer.widget.children[1].children
    for name, slider in explorer.sliders.items():
        begun = slider.value
        for end in (slider.min, slider.max):
            before = bytes(png.value)
            slider.value = end
            assert slider.value == end
            told = message.value.startswith(("OK", "STUCK_FOREVER"))
            assert told != ("must be" in message.value), (name, message.value)
            assert told or bytes(png.value) == before
            slider.value = begun


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda osc: jb.explore(osc, (1.0, 2.0, 3.0)), "start must be of shape"),
        (lambda osc: jb.explore(osc, t1=0.0), "t1 must be > 0"),
    ],
)
def test_impossible_arguments(call, message):
    with pytest.raises((ValueError, TypeError), match=message):
        call(jb.presets.class_a(0.3))
