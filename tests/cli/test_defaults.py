"""What nobody declared is said, and taken from measurements where these tell it."""

from pathlib import Path

import pytest

from radiotwin.scene import Scene

TOWN = Path(__file__).parents[1] / "scene" / "readers" / "town.osm"
DEVICES = "device,x_m,y_m,z_m,role,frequency_hz\na,-40,0,20,anchor,868e6\nb,40,30,20,anchor,868e6\n"


def drive(height, column):
    head = "time_s,flight,receiver,receiver_x_m,receiver_y_m,receiver_z_m,device,rssi_dbm" + column
    rows = [f"{i},f,car,{-100 + i},-60,{height(i)},{'ab'[i % 2]},{-60 - i % 31}" + f",{1.5 + i % 2}" * bool(column) for i in range(160)]
    return "\n".join([head, *rows, ""])


@pytest.fixture
def place(tmp_path):
    (tmp_path / "devices.csv").write_text(DEVICES)
    (tmp_path / "car.csv").write_text(drive(lambda i: 1.5, ""))
    (tmp_path / "drone.csv").write_text(drive(lambda i: 30 + i % 3 * 20, ""))
    (tmp_path / "hill.csv").write_text(drive(lambda i: "", ",receiver_above_ground_m"))
    return tmp_path


def test_defaults_are_said(run, place):
    said = " ".join(run(f"build-scene {TOWN} --check", place).stdout.split())
    assert "2.4 GHz (default: --frequency-hz or --measurements); bandwidth 1 MHz, noise -102 dBm" in said
    assert "2.4 GHz (default" not in " ".join(run(f"build-scene {TOWN} --check --frequency-hz 868e6", place).stdout.split())


@pytest.mark.parametrize("file, options, frequency_hz, altitudes_m", [
    ("car.csv", "", 868e6, [1.5]), ("drone.csv", "", 868e6, [30, 50, 70]), ("hill.csv", "", 868e6, [1.5]),
    ("car.csv", "--frequency-hz 2.1e9 --altitudes 3,9", 2.1e9, [3, 9])])
def test_measurements_tell_frequency_and_heights(run, place, file, options, frequency_hz, altitudes_m):
    done = run(f"build-scene {TOWN} -o scene --origin 47.5,8.7 --measurements {file} {options}", place)
    assert done.returncode == 0, done.stderr
    config = Scene.load(place / "scene").config
    assert config.radio.frequency_hz == frequency_hz and config.lattice.altitudes_m == pytest.approx(altitudes_m, abs=0.51)


def test_a_map_far_from_what_was_measured_says_so(run, place):
    assert run(f"build-scene {TOWN} -o roofs --frequency-hz 868e6", place).returncode == 0
    assert run(f"build-scene {TOWN} -o streets --measurements car.csv", place).returncode == 0
    done = run("fit car.csv --scene roofs --shift 0,0 --model log_distance -o twin", place)
    assert done.returncode == 0, done.stderr
    above = run("map twin --scene roofs -o roofs.nc", place)
    assert above.returncode == 0 and "learnt at 1.5 to 1.5 m above the ground, and the lattice of roofs is at 40 to 50 m" in above.stderr
    assert "--altitudes 1.5" in above.stderr and "is an extrapolation" not in run("map twin --scene streets -o streets.nc", place).stderr
