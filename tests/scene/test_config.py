"""scene.toml: round trip, and one clear message for every kind of mistake."""

import pytest

from radiotwin.errors import BadInput
from radiotwin.scene.config import read_config, write_config
from radiotwin.scene.presets import preset_config

GOOD = """
schema = "radiotwin.scene/1"
name = "town"
[radio]
frequency_hz = 3.5e9
[extent]
x_min_m = 0
x_max_m = 100
y_min_m = 0
y_max_m = 60
[lattice]
step_m = 20
altitudes_m = [50]
[[devices]]
device = "d0"
x_m = 1
y_m = 2
[[uavs]]
uav = "u"
altitude_m = 50
start_x_m = 20
start_y_m = 40
terminal_x_m = 0
terminal_y_m = 0
battery = 10
"""


def write(tmp_path, text):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return path


def test_defaults_are_filled_in(tmp_path):
    config = read_config(write(tmp_path, GOOD))
    assert config.radio.frequency_hz == 3.5e9 and config.radio.noise_dbm == -102
    assert config.devices[0].z_m == 1.5 and config.devices[0].role == "unknown"
    assert config.gain_limit_db == -120


@pytest.mark.parametrize("name", ["rbm", "rdm", "small"])
def test_presets_come_back_from_their_file(tmp_path, name):
    config = preset_config(name)
    write_config(config, tmp_path / "scene.toml")
    assert read_config(tmp_path / "scene.toml") == config


@pytest.mark.parametrize(("old", "new", "message"), [
    ("frequency_hz = 3.5e9", "frequency_hz = -1", r"radio\.frequency_hz = -1: .*greater than or equal to 1000000"),
    ("frequency_hz = 3.5e9", "frequency_hz = inf", r"radio\.frequency_hz = inf"),
    ("frequency_hz = 3.5e9", 'frequency_hz = "high"', r"radio\.frequency_hz = 'high'.*number"),
    ("frequency_hz = 3.5e9", "frequenzy_hz = 1e9", r"radio\.frequenzy_hz: unknown key"),
    ("step_m = 20", "step_m = 0", r"lattice\.step_m = 0"),
    ("x_max_m = 100", "x_max_m = -100", r"extent: x_max_m and y_max_m must be greater"),
    ("x_max_m = 100\n", "", r"extent\.x_max_m: missing"),
    ("altitudes_m = [50]", "altitudes_m = []", r"lattice\.altitudes_m"),
    ("altitude_m = 50", "altitude_m = 55", r"'u': altitude_m = 55 is not one of lattice\.altitudes_m"),
    ("start_x_m = 20", "start_x_m = 25", r"'u': start_x_m = 25 is not on the lattice"),
    ('device = "d0"', 'device = "d 0"', r"devices\.0\.device = 'd 0'"),
    ("x_m = 1\n", "x_m = 1\nrole = 'anker'\n", r"devices\.0\.role = 'anker': .*'anchor' or 'unknown'"),
    ("[[uavs]]", "[[devices]]\ndevice = 'd0'\nx_m = 3\ny_m = 3\n[[uavs]]", r"device 'd0' is declared twice"),
    ("radiotwin.scene/1", "radiotwin.scene/9", r"schema = 'radiotwin.scene/9'"),
    ("[radio]", "[radio", r"not valid TOML"),
])
def test_mistakes_name_file_key_and_value(tmp_path, old, new, message):
    assert old in GOOD
    path = write(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(BadInput, match=message) as error:
        read_config(path)
    assert str(path) in str(error.value)


def test_no_file(tmp_path):
    with pytest.raises(BadInput, match="does not exist"):
        read_config(tmp_path / "scene.toml")
