"""scene.toml: round trip, and one clear message for every kind of mistake."""

from pathlib import Path

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


@pytest.mark.parametrize("name", ["rbm", "rdm"])
def test_the_scenes_that_ship_are_read(name):
    config = read_config(Path(__file__).parents[2] / "scenes" / name / "scene.toml")
    assert config == preset_config(name)


@pytest.mark.parametrize("devices", [0, 1, 7])
def test_a_device_can_be_appended_by_hand(tmp_path, devices):
    config = preset_config("small")
    config = config.model_copy(update={"devices": config.devices[:devices]})
    write_config(config, tmp_path / "scene.toml")
    with (tmp_path / "scene.toml").open("a") as file:
        file.write("[[devices]]\ndevice = 'mine'\nx_m = 5\ny_m = 6\n")
    again = read_config(tmp_path / "scene.toml")
    assert again.devices[:-1] == config.devices and again.uavs == config.uavs
    assert again.devices[-1].device == "mine" and again.devices[-1].x_m == 5


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("old", "new", "message"), [
    ("frequency_hz = 3.5e9", "frequency_hz = -1", r"radio\.frequency_hz = -1: allowed is 1e6 Hz to 450e9 Hz .*GHz"),
    ("frequency_hz = 3.5e9", "frequency_hz = 3.5e12", r"radio\.frequency_hz = 3500000000000.0: allowed is 1e6 Hz"),
    ("frequency_hz = 3.5e9", "frequency_hz = true", r"radio\.frequency_hz = True: .*valid number"),
    ("frequency_hz = 3.5e9", "sensitivity_dbm = 5", r"radio: sensitivity_dbm = 5 must lie below tx_power_dbm"),
    ("altitudes_m = [50]", "altitudes_m = [50, true]", r"lattice\.altitudes_m\.1 = True: .*valid number"),
    ("altitudes_m = [50]", "altitudes_m = [50, 60, 50.0]", r"lattice\.altitudes_m.*50 is listed twice"),
    ("step_m = 20", "step_m = 0.001", r"lattice\.step_m = 0\.001 over an extent of 100 x 60 m .*positions"),
    ("step_m = 20", "step_m = 1e-300", r"lattice\.step_m = 1e-300: .* 0.000001 m"),
    ("x_m = 1\n", "x_m = 100.5\n", r"device 'd0' at \(100\.5, 2\) m lies outside the extent \(x 0 to 100 m, y 0 to"),
    ("battery = 10\n", "battery = 100001\n", r"uavs\.0\.battery = 100001: .*100000"),
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
    ("[radio]", "[radio", r"not readable TOML"),
    ("y_m = 2\n", "y_m = 2\nz_m = 2\nabove_ground_m = 2\n", r"devices.0: z_m \(above the datum\) and above_ground_m are both given"),
    ("step_m = 20", "step_m = 20\nabove = 'sea'", "lattice.above = 'sea': Input should be 'datum' or 'ground'"),
    ("x_max_m = 100", "x_max_m = 1e308", r"extent\.x_max_m = 1e\+308: .* 1000000 m"),
    ("x_max_m = 100", "x_max_m = 10_000_000", r"extent\.x_max_m = 10000000: .* 1000000 m"),
    ("x_m = 1\n", "x_m = -1e7\n", r"devices\.0\.x_m = -10000000\.0: .* -1000000 m"),
    ("x_m = 1\n", f"x_m = 1{'0' * 400}\n", r"devices\.0\.x_m = 1000"),
    ("x_m = 1\n", f"x_m = 1{'0' * 5000}\n", "not readable TOML"),
    ("y_m = 2\n", "y_m = 2\nz_m = 1e308\n", r"devices\.0\.z_m = 1e\+308: .* 1000000 m"),
    ("altitudes_m = [50]", "altitudes_m = [50, 1e308]", r"lattice\.altitudes_m\.1 = 1e\+308: .* 1000000 m"),
    ("frequency_hz = 3.5e9", "noise_dbm = 1e308", r"radio\.noise_dbm = 1e\+308: .* 50 dBm"),
    ("frequency_hz = 3.5e9", "bandwidth_hz = 1e308", r"radio\.bandwidth_hz = 1e\+308: .* 450000000000 Hz"),
    ("step_m = 20", "step_m = 1e-9", r"lattice\.step_m = 1e-09: .* m$"),
    ("step_m = 20", "step_m = 1e-6", r"scene.toml: lattice\.step_m = 1e-06 over an extent of 100 x 60 m .* 6e\+15 positions"),
    ("[[uavs]]", "[mission]\nslot_s = 1e308\n[[uavs]]", r"mission\.slot_s = 1e\+308: .* 86400 s"),
    ("[[uavs]]", "[mission]\ndata_units = 1e308\n[[uavs]]", r"mission\.data_units = 1e\+308"),
    ("[radio]", "[origin]\nlatitude_deg = 1\nlongitude_deg = 1\naltitude_m = 1e308\n[radio]", r"origin\.altitude_m = .* m"),
    ('name = "town"', f'name = "town"\n{"a" * 3000} = 1', r"a{60}: unknown key"),
    ('name = "town"', 'name = ".."', r"name = '\.\.'"), ('device = "d0"', 'device = ".."', r"device = '\.\.'"),
    ('device = "d0"', 'device = "../d"', r"device = '\.\./d'"), ('uav = "u"', 'uav = ".hidden"', r"uav = '\.hidden'"),
    ('device = "d0"', 'device = "d\\n0"', r"device = 'd\\n0'"), ('device = "d0"', 'device = "d0\\n"', r"device = 'd0\\n'"),
    ('device = "d0"', 'device = "\\u001b[31m"', r"device = '\\x1b\[31m'"),
    *(('x_m = 1\n', f'x_m = 1\nantenna = {name}\n', r"devices\.0\.antenna = .*below the scene folder") for name in (
        '"../a.msi"', '"/etc/passwd"', '"a/../../b.msi"', "'C:\\a.msi'", '"a\\u0000.msi"', '""', '"a\\n.msi"', f'"{"a" * 300}"')),
    ("[radio]", "a" + ".a" * 20_000 + " = 1\n[radio]", "a key of more than 100 parts"),
    ("[radio]", "a = " + "[" * 100_000 + "\n[radio]", "levels of nesting"),
])
def test_mistakes_name_file_key_and_value(tmp_path, old, new, message):
    assert old in GOOD
    path = write(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(BadInput, match=message) as error:
        read_config(path)
    assert str(path) in str(error.value) and len(str(error.value)) < 700 + len(str(tmp_path))


def many(count, device="device = 'd{}'\nx_m = 1\ny_m = 2\n", uav="", altitudes=1):
    base = GOOD.split("[[devices]]")[0].replace("[50]", str([50 + i / 4 for i in range(altitudes)]))
    return base + "".join(f"[[devices]]\n{device.format(i)}" for i in range(count)) + "".join(
        f"[[uavs]]\nuav = 'u{i}'\naltitude_m = 50\nstart_x_m = 0\nstart_y_m = 0\nterminal_x_m = 0\n"
        f"terminal_y_m = 0\nbattery = 1\n" for i in range(count if uav else 0))


def test_thousands_of_devices_and_altitudes_are_read(tmp_path):
    """Seen: 20,000 devices or altitudes took minutes."""
    config = read_config(write(tmp_path, many(5_000, uav="u", altitudes=5_000)))
    assert len(config.devices) == len(config.uavs) == len(config.lattice.altitudes_m) == 5_000


def test_budgets_and_the_first_mistakes_of_many(tmp_path, monkeypatch):
    path = write(tmp_path, many(30, device="device = '/{}'\nx_m = 1\ny_m = 2\n"))
    with pytest.raises(BadInput, match="and 20 more such mistakes"):
        read_config(path)
    monkeypatch.setenv("RADIOTWIN_MAX_DEVICES", "29")
    with pytest.raises(BadInput, match="30 devices; at most 29 .* RADIOTWIN_MAX_DEVICES"):
        read_config(path)
    path = write(tmp_path, many(3, uav="u"))
    monkeypatch.setenv("RADIOTWIN_MAX_UAVS", "2")
    with pytest.raises(BadInput, match="3 UAVs; at most 2 .* RADIOTWIN_MAX_UAVS"):
        read_config(path)


@pytest.mark.parametrize("end_m, is_there", [(80, True), (80.005, True), (99.995, False), (100, False)])
def test_a_flight_ends_where_the_lattice_does(tmp_path, end_m, is_there):
    """The extent is 5 mm short of a whole number of steps: the lattice's last column is that before."""
    text = GOOD.replace("x_max_m = 100", "x_max_m = 99.995").replace("start_x_m = 20", f"start_x_m = {end_m}")
    path = write(tmp_path, text)
    if is_there:
        assert read_config(path).uavs[0].start_x_m == end_m
    else:
        with pytest.raises(BadInput, match=r"not on the lattice \(0 to 80 m in steps of 20 m\)|lies outside"):
            read_config(path)
