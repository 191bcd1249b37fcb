"""Plots, and what a notebook shows."""

import pytest

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("agg")
import matplotlib.pyplot as plt

import cantap

DBC = """\
VERSION ""
BU_: ECU
BO_ 291 Engine: 8 ECU
 SG_ Speed : 0|8@1+ (0.5,0) [0|200] "km/h" ECU
 SG_ Gear : 8|4@1+ (1,0) [0|8] "" ECU
BO_ 292 Body: 8 ECU
 SG_ Speed : 0|8@1+ (1,0) [0|200] "km/h" ECU
"""


@pytest.fixture
def files(tmp_path):
    (tmp_path / "drive.log").write_text("".join(f"({at}.000000) can0 {0x123 + at % 2:X}#{at:02X}\n" for at in range(10)))
    (tmp_path / "car.dbc").write_text(DBC)
    yield tmp_path / "drive.log", tmp_path / "car.dbc"
    plt.close("all")


def test_a_messages_signals_are_plotted_over_time(files):
    drive = cantap.decode(*files)
    axes = drive["Engine"].plot("Speed", color="red")
    [line] = axes.get_lines()
    assert list(line.get_ydata()) == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert axes.get_ylabel() == "km/h" and line.get_label() == "Speed [km/h]" and line.get_color() == "red"
    # A signal that is in no frame is a line of gaps.
    assert len(drive["Engine"].plot().get_lines()) == 2
    assert drive.plot("Engine.Speed", "Body.Speed", ax=axes) is axes and len(axes.get_lines()) == 3


def test_a_table_of_values_is_plotted_by_signal(files):
    table = cantap.read(files[0], db=files[1], filter="123")
    [line] = table.plot("Speed").get_lines()
    assert list(line.get_ydata()) == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_what_cannot_be_plotted_says_what_can(files):
    drive = cantap.decode(*files)
    with pytest.raises(ValueError, match="Engine.Speed and Body.Speed"):
        drive.plot("Speed")
    for wrong in (lambda: drive.plot(), lambda: drive.plot("Sped"), lambda: drive["Engine"].plot("Sped"), lambda: cantap.read(files[0]).plot()):
        with pytest.raises(ValueError):
            wrong()
    with pytest.raises(ValueError, match="there is no signal 'Sped'"):
        cantap.read(files[0], db=files[1]).plot("Sped")


def test_a_notebook_shows_the_messages(files):
    html = cantap.decode(*files)._repr_html_()
    assert "<td>Engine</td><td>5</td><td>Speed, Gear</td>" in html
