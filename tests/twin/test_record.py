"""Every part of twin.json wrong in every way: one message, or a twin that predicts without exceptions."""

import copy
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.links import prepare_links
from radiotwin.links.measurements import read_measurements
from radiotwin.twin import Twin

STORED = Path(__file__).parent / "stored"
NO_MAP = SimpleNamespace(config=SimpleNamespace(radio=SimpleNamespace(frequency_hz=2.4e9)), city=None)
EFFECTS = [each for each in json.loads((STORED / "effects.json").read_text(encoding="utf-8"))
           if each["over"] == "links"]
DEEP = json.loads("[" * 200 + "]" * 200)
WRONG = [None, "text", "1", [], [1], {}, {"a": 1}, True, -1, 0, 0.5, 1e308, -1e308, float("nan"), 2**70, 10**400, DEEP]


def paths(value, path=()):
    """Paths of all nodes of a document; of a list's only the first two."""
    yield path
    if isinstance(value, dict):
        for name in value:
            yield from paths(value[name], (*path, name))
    elif isinstance(value, list):
        for number in range(min(len(value), 2)):
            yield from paths(value[number], (*path, number))


def replaced(record, path, new):
    if not path:
        return new
    record = copy.deepcopy(record)
    at = record
    for name in path[:-1]:
        at = at[name]
    at[path[-1]] = new
    return record


def read(name):
    folder = STORED / name
    return json.loads((folder / "twin.json").read_text(encoding="utf-8")), (folder / "channel.safetensors").read_bytes()


def document(name):
    record, channel = read(name)
    shadowing = record["fitted"]["shadowing"]
    if shadowing:
        shadowing["arrays"] = {key: values[:6] for key, values in shadowing["arrays"].items()}
    return record, channel


@pytest.fixture(scope="module")
def measured():
    return prepare_links(read_measurements(STORED / "links" / "measurements.csv"), None).select(slice(0, 40))


def check(record, channel, measured):
    """Read the record; what is accepted predicts finite levels and is written again."""
    try:
        twin = Twin.decode(json.dumps(record), channel, "it")
    except BadInput as error:
        assert len(str(error)) < 1000
        return "refused"
    twin.encode()
    if not twin.channel.follows_paths:
        rng = np.random.default_rng(0)
        receiver_m = np.column_stack([rng.uniform(0, 500, (20, 2)), np.full(20, 60.0)])
        try:
            predicted = twin.predict(twin.links(receiver_m, np.arange(20) % len(twin.devices), NO_MAP))
            assert np.isfinite([predicted.mean_db, predicted.sd_db]).all()
            if not twin.fitted.is_channel_alone and len(twin.devices) == len(measured.device_names):
                twin.predict(measured)
        except BadInput:
            return "refused"
    return "accepted"


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", ["corrected", "raytrace"])
def test_every_node_wrong_in_every_way(name, measured):
    record, channel = document(name)
    assert check(record, channel, measured) == "accepted"
    every = list(paths(record))
    rng = np.random.default_rng(2)  # some of 2,700 cases
    found = [check(replaced(record, path, new), channel, measured)
             for path in every for new in WRONG if rng.random() < 0.05]
    assert found.count("refused") > 4 * found.count("accepted") > 0


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("number", range(len(EFFECTS)), ids=[f"{each['name']}-{i}" for i, each in enumerate(EFFECTS)])
def test_parameters_of_every_effect_wrong_in_every_way(number, measured):
    record, channel = document("corrected")
    part = {name: value for name, value in EFFECTS[number].items() if name != "over"}
    record["fitted"] |= {"effects": [part], "shadowing": None}
    assert check(record, channel, measured) == "accepted"
    rng = np.random.default_rng(number)
    for path in paths(part):
        for new in rng.permutation(np.array(WRONG, dtype=object))[:5]:
            record["fitted"]["effects"] = [replaced(part, path, new)]
            check(record, channel, measured)


REFUSED = {
    "no effects": lambda r: r | {"fitted": "text"},
    "degrees of freedom": lambda r: r["fitted"].update(dof=-1),
    "an unknown key": lambda r: r.update(extra=1),
    "an unknown key of a device": lambda r: r["devices"][0].update(extra=1),
    "a far device": lambda r: r["devices"][0].update(x_m=1e300),
    "a receiver twice": lambda r: r["fitted"].update(receivers=["r0", "r0"]),
    "another channel": lambda r: r["channel"].update(model="segmented_nn"),
    "another file": lambda r: r["channel"].update(file="../../secret"),
    "too many levels": lambda r: r["fitted"].update(level_coefficients=[0.0, 0.0, 0.0]),
    "a coefficient too many": lambda r: r["fitted"]["effects"][0]["coefficients"].append(1.0),
    "a member that is not there": lambda r: r["fitted"]["effects"][0]["params"].update(members=[0, 7]),
    "a member twice": lambda r: r["fitted"]["effects"][0]["params"].update(members=[0, 0]),
    "a number as a text": lambda r: r["fitted"]["effects"][0]["params"].update(offsets_sd_db="2"),
    "a huge length": lambda r: r["fitted"]["shadowing"]["settings"].update(length_m=1e308),
    "negative shares": lambda r: r["fitted"]["shadowing"]["settings"].update(share=-0.5),
    "points of another shape": lambda r: r["fitted"]["shadowing"]["arrays"].update({"residual/0": [1.0]}),
    "a scene that is no text": lambda r: r["provenance"].update(scene=["x"])}


@pytest.mark.parametrize("change", REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_is_refused(change, measured):
    record, channel = document("corrected")
    record = change(record) or record
    assert check(record, channel, measured) == "refused"


def test_a_twins_files_are_regular_and_of_a_bounded_size(tmp_path, monkeypatch):
    record, channel = read("corrected")
    (tmp_path / "twin.json").write_text(json.dumps(record))
    (tmp_path / "channel.safetensors").write_bytes(channel)
    Twin.load(tmp_path)
    monkeypatch.setenv("RADIOTWIN_MAX_FILE_BYTES", "100")
    with pytest.raises(BadInput, match="RADIOTWIN_MAX_FILE_BYTES"):
        Twin.load(tmp_path)
    (tmp_path / "channel.safetensors").unlink()
    (tmp_path / "channel.safetensors").symlink_to("/dev/zero")
    with pytest.raises(BadInput, match="leads out of"):
        Twin.load(tmp_path)
