import os

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.scene.antennas import Antenna, read_pattern


def msi(gain="15 dBi", horizontal=lambda a: min(12 * (min(a, 360 - a) / 65) ** 2, 25),
        vertical=lambda a: min(12 * (min(abs(a - 6), 360 - abs(a - 6)) / 15) ** 2, 30), count=360):
    cuts = {"HORIZONTAL": horizontal, "VERTICAL": vertical}
    lines = ["NAME sector", "MAKE nobody", "FREQUENCY 2400", f"GAIN {gain}", "TILT ELECTRICAL", "COMMENT 65 degrees"]
    for name, cut in cuts.items():
        lines += [f"{name} {count}", *(f"{a * 360 / count:.1f}\t{cut(a * 360 / count):.4f}" for a in range(count))]
    return "\n".join(line for line in lines if line != "GAIN ") + "\n"


def write(tmp_path, text, name="a.msi"):
    (tmp_path / name).write_text(text)
    return tmp_path / name


@pytest.mark.parametrize(("gain", "peak_dbi"), [("15 dBi", 15), ("12.85 dBd", 15), ("12.85", 15), ("15.0dBi", 15)])
def test_msi_says_its_gain_in_dbi_or_dbd(tmp_path, gain, peak_dbi):
    assert read_pattern(write(tmp_path, msi(gain))).at(0, -6) == pytest.approx(peak_dbi, abs=1e-6)


def test_msi_cuts_are_kept_and_the_downtilt_looks_down(tmp_path):
    """Rationale: with a downtilt of 6 degrees the vertical cut is highest 6 degrees below the horizon."""
    pattern = read_pattern(write(tmp_path, msi()))
    azimuth, elevation = np.unravel_index(pattern.gain_dbi.T.argmax(), pattern.gain_dbi.T.shape)
    assert (pattern.azimuth_deg[azimuth], pattern.elevation_deg[elevation]) == (0, -6)
    fall_db = 12 * (10 / 15) ** 2
    assert pattern.at(0, np.array([-6.0, 4.0, -16.0])) == pytest.approx(15 - np.array([0, fall_db, fall_db]), abs=1e-3)
    assert pattern.at(180, np.array([0.0, 30.0])) == pytest.approx(15 - 30)  # behind: the vertical cut beyond 90


def test_on_the_horizon_the_horizontal_cut_counts(tmp_path):
    """Where both cuts agree in front (0 dB) and behind (25 dB)."""
    pattern = read_pattern(write(tmp_path, msi(vertical=lambda a: min(12 * (min(a, 360 - a) / 15) ** 2, 25))))
    assert pattern.at(np.array([0.0, 32.5, 65.0, 180.0]), 0) == pytest.approx(15 - np.array([0, 3, 12, 25]), abs=1e-2)


def test_rows_every_five_degrees_will_do(tmp_path):
    coarse, fine = read_pattern(write(tmp_path, msi(count=72))), read_pattern(write(tmp_path, msi(), "b.msi"))
    assert coarse.gain_dbi[::5, ::5] == pytest.approx(fine.gain_dbi[::5, ::5])


def test_csv(tmp_path):
    rows = [f"{a}, {e}, {a / 10 - e / 5}" for a in (-90, 0, 90, 180) for e in (-90, 0, 90)]
    pattern = read_pattern(write(tmp_path, "azimuth_deg, elevation_deg, gain_dbi\n" + "\n".join(rows), "a.csv"))
    assert pattern.at(45, 0) == pytest.approx(4.5) and pattern.at(-90, 45) == pytest.approx(-18)
    assert pattern.at(315, 0) == pytest.approx(-4.5)


@pytest.mark.parametrize(("name", "text", "message"), [
    ("a.txt", "", "unknown format '.txt'"), ("a.msi", "", "has no cut HORIZONTAL"),
    ("a.msi", msi(gain=""), "has no GAIN"), ("a.msi", msi(gain="99 dBi"), "99 dBi is not"),
    ("a.msi", msi(gain="loud"), "row 4: 'GAIN loud' is not GAIN, a number"),
    ("a.msi", msi(horizontal=lambda a: -3), "row 8: .* is not an angle"),
    ("a.msi", msi(vertical=lambda a: float("nan")), "row 369: .* is not an angle"),
    ("a.msi", msi().split("VERTICAL")[0], "has no cut VERTICAL"),
    ("a.csv", "azimuth_deg,gain_dbi\n1,2\n", "column 'elevation_deg' is missing"),
    ("a.csv", "azimuth_deg,elevation_deg,gain_dbi\n0,0,1\n90,45,2\n", "no full grid of 2 elevations and 2 azimuths"),
    ("a.csv", "azimuth_deg,elevation_deg,gain_dbi\n", "no full grid of 0 elevations"),
    ("a.csv", "azimuth_deg,elevation_deg,gain_dbi\n0,0,x\n", "row 2, column gain_dbi: 'x' is not a number"),
    ("a.csv", "azimuth_deg,elevation_deg,gain_dbi\n0,91,1\n", "row 2, column elevation_deg"),
])
def test_broken_patterns(tmp_path, name, text, message):
    with pytest.raises(BadInput, match=message) as error:
        read_pattern(write(tmp_path, text, name))
    assert str(tmp_path / name) in str(error.value)


HEAD = "azimuth_deg,elevation_deg,gain_dbi\n"
GRID = "0,0,10\n90,0,1\n0,90,0\n90,90,0\n"
LATER = "HORIZONTAL 1\n360 {}\n"


@pytest.mark.parametrize(("name", "text", "same", "other", "message"), [
    ("a.csv", HEAD + GRID + "360,0,{}\n", 10.1, -20, "row 6: azimuth 0, elevation 0 has -20 dB, an earlier .* 10 dB"),
    ("a.csv", HEAD + GRID + "-270,0,{}\n", 0.95, 1.2, "row 6: azimuth 90, elevation 0 has 1.2 dB"),
    ("a.msi", msi() + "0 {}\n", 1.92, 3, "row 729: angle 0 has 3 dB, an earlier row of this direction 1.92 dB"),
    ("a.msi", msi() + LATER, 0.1, 25, "row 730: angle 360 has 25 dB, an earlier row of this direction 0 dB")])
def test_rows_of_one_direction_must_agree(tmp_path, name, text, same, other, message):
    once = read_pattern(write(tmp_path, text.rpartition("\n")[0].rpartition("\n")[0], name))
    again = read_pattern(write(tmp_path, text.format(same), name))
    assert (again.gain_dbi == once.gain_dbi).all()
    with pytest.raises(BadInput, match=message):
        read_pattern(write(tmp_path, text.format(other), name))


@pytest.mark.filterwarnings("error")
def test_a_grid_is_counted_before_it_is_made(tmp_path):
    """Seen: 40,000 rows, no two with a common angle, are a grid of 1.6 billion cells."""
    rows = "\n".join(f"{i / 1000},{i / 1000 - 20},1" for i in range(40_000))
    with pytest.raises(BadInput, match="40000 rows are no full grid of 40000 elevations and 40000 azimuths"):
        read_pattern(write(tmp_path, "azimuth_deg,elevation_deg,gain_dbi\n" + rows, "a.csv"))


def test_no_gain_is_higher_than_the_peak(tmp_path):
    """Rationale: beyond a grid of elevations, a line through its last two may lead anywhere."""
    text = "azimuth_deg,elevation_deg,gain_dbi\n" + "\n".join(
        f"{a},{e},{g}" for a in (-1e-20, 90) for e, g in ((0, 0), (1e-6, 60)))
    pattern = read_pattern(write(tmp_path, text, "a.csv"))
    assert pattern.at([0, 45, 359], [90, 45, -90]).tolist() == [60, 60, 0]


def test_pipes_and_large_files_are_refused(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "p.msi")
    with pytest.raises(BadInput, match="not a regular file"):
        read_pattern(tmp_path / "p.msi")
    monkeypatch.setenv("RADIOTWIN_MAX_DOCUMENT_BYTES", "100")
    with pytest.raises(BadInput, match="at most 100"):
        read_pattern(write(tmp_path, msi()))


def test_azimuths_of_an_msi_file_are_clockwise(tmp_path):
    """A horizontal cut that falls to 20 dB on its right, at 90 degrees, and not on its left."""
    pattern = read_pattern(write(tmp_path, msi(horizontal=lambda a: 20 * max(np.sin(np.radians(a)), 0.0),
                                               vertical=lambda a: 0.0)))
    assert pattern.at(np.array([90.0, -90.0, 270.0]), 0) == pytest.approx(15 - np.array([20, 0, 0]), abs=1e-2)
    east, west = Antenna(pattern).gain_dbi(np.array([[1.0, 0, 0], [-1.0, 0, 0]]))
    assert (east, west) == (pytest.approx(-5, abs=1e-2), pytest.approx(15, abs=1e-2))
