"""A party of a federation, driven from outside, and the means of several in one process."""

import re
import shutil

import numpy as np
import pandas as pd
import pytest

import marl.replicas
from marl.algorithm1 import run_algorithm
from marl.fedqmix.client import Client, Party
from marl.fedqmix.federation import FedQMIX, average, initial_weights, require_weights, rounds_of
from marl.fedqmix.session import FederatedSession
from marl.fedqmix.settings import FederationSettings, Shared
from marl.settings import PRESETS, RunSettings
from radiotwin.errors import BadInput
from radiotwin.maps.survey import fly_survey, segmented_truth
from radiotwin.runtime.command import exit_status

LEARNER = PRESETS["fast"].model_copy(update={
    "parallel": 4, "batch": 4, "replay": 16, "hidden": 8, "mixing_width": 4, "federate_every": 8,
    "selection_flights": 2, "epsilon_slots": 500})
RUN = RunSettings(truth="segmented", twin="log-distance", real_episodes=2, episodes=12, flights=2, device="cpu")


@pytest.fixture(autouse=True)
def one_process(monkeypatch):
    monkeypatch.setattr(marl.replicas, "usable_cores", lambda: 1)


@pytest.fixture
def shared(small_scene):
    config = small_scene.config
    return Shared(run=RUN, learner=LEARNER, clients=2, uavs=len(config.uavs), devices=len(config.devices))


@pytest.fixture
def parties(small_scene, tmp_path):
    return [Party(small_scene.folder, tmp_path / str(number), number, "segmented")
            for number in range(len(small_scene.config.uavs))]


def in_truth(shared):
    return shared.model_copy(update={"run": shared.run.model_copy(update={"twin": "truth"})})


def play(shared, party, means, rounds, keep):
    """Weights of some rounds, from one client, or from a new one in each, as Flower has it."""
    client, weights = Client(shared.run, shared.learner, party), []
    for number in rounds:
        client = client if keep else Client(shared.run, shared.learner, party)
        weights.append(client.train(number, means[number - 1])[0])
    return weights, client


def test_rounds_are_the_blocks_between_real_episodes():
    run = RUN.model_copy(update={"real_episodes": 2, "episodes": 20})
    assert rounds_of(run, LEARNER) == [(0, 8), (0, 8), (0, 4), (1, 8), (1, 8), (1, 4)]


def test_means_and_policy_are_those_of_fedqmix(small_scene, shared, parties, monkeypatch):
    # The learner of one owner, and parties that know nothing of each other: the same bits after every round.
    means, train = [], FedQMIX._train

    def seen(self, episodes):
        record, mean = train(self, episodes)
        means.append(mean)
        return record, mean

    monkeypatch.setattr(FedQMIX, "_train", seen)
    run = shared.run.model_copy(update={"scene": small_scene.folder})
    outcome = run_algorithm(run, LEARNER, small_scene, segmented_truth(small_scene), None, False,
                            lambda rows, blocks: None, lambda *given: None)
    own = initial_weights(shared)
    for number, mean in enumerate(means, 1):
        # From its checkpoint in every round, as Flower starts it.
        own = average([Client(shared.run, LEARNER, party).train(number, own)[0] for party in parties])
        for name in mean:
            np.testing.assert_array_equal(mean[name], own[name])
    assert len(means) == 4
    for party in parties:
        Client(shared.run, LEARNER, party).finish(own)
        table = pd.read_csv(party.folder / "metrics.csv")
        for name in ("truth_ratio", "twin_ratio", "location_error_worst_m"):
            np.testing.assert_allclose(table[name], [row[name] for row in outcome.rows], rtol=1e-6)


def test_a_party_goes_on_from_its_checkpoint_to_the_bit(shared, parties, tmp_path):
    shared = in_truth(shared)
    means = [initial_weights(shared)] * 4
    other = Party(parties[0].scene, tmp_path / "other", 0, "segmented")
    kept, client = play(shared, parties[0], means, (1, 2, 3, 4), keep=True)
    anew, last = play(shared, other, means, (1, 2, 3, 4), keep=False)
    for a, b in zip(kept, anew):
        for name in a:
            np.testing.assert_array_equal(a[name], b[name])
    assert client.finish(means[0]) == last.finish(means[0]) == RUN.flights
    a, b = (pd.read_csv(folder / "metrics.csv") for folder in (parties[0].folder, other.folder))
    same = [name for name in a if not name.endswith("_s")]
    pd.testing.assert_frame_equal(a[same], b[same])


def test_a_party_that_missed_rounds_goes_on(shared, parties):
    means = [initial_weights(shared)] * 4
    _, client = play(in_truth(shared), parties[0], means, (1, 4), keep=False)
    table = pd.read_csv(parties[0].folder / "metrics.csv")
    assert len(table) == 1 and table["simulated_episodes"][0] == 8
    # In the truth all are real, and so are the flights that chose between the policies of one round.
    assert table["real_episodes"][0] == 8 + shared.learner.selection_flights
    with pytest.raises(BadInput, match="round 4 is asked for; rounds 5 to 4"):
        client.train(4, means[0])


def test_a_party_with_measurements_flies_nothing(small_scene, shared, tmp_path):
    truth = segmented_truth(small_scene)
    path = tmp_path / "measurements.csv"
    fly_survey(small_scene, truth, flights=2, pattern="random-waypoint", seed=3).save(path)
    party = Party(small_scene.folder, tmp_path / "out", 0, "segmented", path)
    client = Client(shared.run, shared.learner, party)
    weights, episodes = client.train(1, initial_weights(shared))
    assert episodes == 8 and weights.keys() == initial_weights(shared).keys()
    client = Client(shared.run, shared.learner, party)
    client.finish(weights)
    table = pd.read_csv(party.folder / "metrics.csv")
    assert table["real_episodes"].tolist() == [2]
    assert table["truth_ratio"].isna().all() and table["twin_ratio"].notna().all()  # it has no truth
    with pytest.raises(BadInput, match="no truth to train in"):
        Client(shared.run.model_copy(update={"twin": "truth"}), shared.learner, party)


def test_a_checkpoint_that_is_none_is_refused(shared, parties):
    shared = in_truth(shared)
    play(shared, parties[0], [initial_weights(shared)], (1,), keep=True)
    path = parties[0].folder / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(BadInput, match="checkpoint"):
        Client(shared.run, shared.learner, parties[0])


@pytest.mark.parametrize("change, message", [
    (lambda w: w.pop("agent.head.bias"), "missing or unknown"),
    (lambda w: w.update(other=np.zeros(1, np.float32)), "missing or unknown"),
    (lambda w: w.update({"agent.head.bias": np.zeros(5, np.float32)}), "equal numbers of UAVs"),
    (lambda w: w.update({"agent.head.bias": np.zeros(6)}), "float64"),
    (lambda w: w["agent.head.bias"].fill(np.nan), "not finite"),
    (lambda w: w["square.0"].fill(-1), "negative"),
])
def test_weights_of_others_are_checked(shared, change, message):
    weights, like = initial_weights(shared), initial_weights(shared)
    require_weights(weights, like)
    change(weights)
    with pytest.raises(BadInput, match=message):
        require_weights(weights, like)


def test_settings_survive_the_way_through_an_app(shared):
    flat = {}
    for group, values in shared.config().items():
        flat |= {f"{group}.{name}": value for name, value in values.items()} if isinstance(values, dict) else {
            group: values}
    own = shared.run.model_copy(update={"truth": "traced", "device": "auto"})
    assert Shared.of(flat) == shared.model_copy(update={"run": own})
    for name, value, message in (("run.scene", "/etc", "not for the coordinator"), ("uavs", "3", "uavs = 3"),
                                 ("learner.hidden", 10**9, "learner.hidden"), ("run.other", 1, "run.other"),
                                 ("min_clients", 3, "there are 2 parties"), ("other.name", 1, "other"), ("other", 1, "other"),
                                 ("learner.replay", 2, "replay")):
        with pytest.raises(BadInput, match=message):
            Shared.of(flat | {name: value})
    with pytest.raises(BadInput, match="devices"):
        Shared.of({name: value for name, value in flat.items() if name != "devices"})


@pytest.mark.parametrize("options, status, message", [
    (["--federation", "flower-app", "--algorithm", "qmix"], 2, "--algorithm fedqmix"),
    (["--federation", "flower-app", "--resume"], 2, "without --resume"),
    (["--federation", "in-process", "--min-clients", "4"], 2, "there are 2 parties"),
    (["--federation", "flower-app", "--min-clients", "4"], 2, "there are 2 parties"),
    (["--federation", "flower"], 2, "in-process|flower-app"),
    (["--federation", "flower-app", "--party-measurements", "a,b,c", "--party-scenes", "x,y"], 2, "3 files for 2"),
    (["--federation", "flower-app"], 0, "app"),
])
def test_options_that_do_not_go_together_end_with_one_message(options, status, message, small_scene, tmp_path,
                                                              monkeypatch, capsys):
    from marl.fedqmix.__main__ import app

    out = tmp_path / "out"
    given = ["--scene", str(small_scene.folder), "--truth", "segmented", "--out", str(out), *options]
    monkeypatch.setattr("sys.argv", ["fedqmix", *given])
    assert exit_status(app, "") == status
    printed = capsys.readouterr()
    assert message in " ".join((printed.out + printed.err).split())
    assert (out / "app" / "pyproject.toml").exists() == (status == 0) == out.exists()


def test_scenes_of_other_sizes_are_refused(small_scene, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(small_scene.folder, other)
    text = (other / "scene.toml").read_text()
    first = text.index("[[uavs]]")
    second = text.index("[[", first + 1)
    (other / "scene.toml").write_text(text[:first] + text[second:])
    federation = FederationSettings(party_scenes=f"{small_scene.folder},{other}")
    run = RUN.model_copy(update={"scene": small_scene.folder})
    with pytest.raises(BadInput, match="equal"):
        FederatedSession(run, LEARNER, federation, tmp_path / "out").execute()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("battery, settings, message", [
    (1.0, {}, "battery"), (40.0, {"batch": 20_000, "hidden": 4096}, "memory|at most|GiB")])
def test_what_cannot_be_trained_is_refused_before_anything_is_written(small_scene, tmp_path, battery, settings, message):
    """A battery that does not reach the terminal; a batch that no memory holds."""
    scene = tmp_path / "scene"
    shutil.copytree(small_scene.folder, scene)
    text = re.sub(r"battery = [\d.]+", f"battery = {battery}", (scene / "scene.toml").read_text())
    (scene / "scene.toml").write_text(re.sub(r"start_x_m = [\d.]+", "start_x_m = 200.0", text))
    federation = FederationSettings(party_scenes=f"{scene},{scene}")
    learner = LEARNER.model_copy(update=settings)
    with pytest.raises(BadInput, match=message):
        FederatedSession(RUN.model_copy(update={"scene": scene}), learner, federation,
                         tmp_path / "out").execute()
    assert not (tmp_path / "out").exists()


def test_a_session_in_one_process_writes_what_each_party_collects(small_scene, tmp_path, capsys):
    federation = FederationSettings(party_scenes=f"{small_scene.folder},{small_scene.folder}")
    run = RUN.model_copy(update={"scene": small_scene.folder, "twin": "truth", "real_episodes": 1, "episodes": 8})
    FederatedSession(run, LEARNER, federation, tmp_path / "out").execute()
    assert "in its truth" in " ".join(capsys.readouterr().out.split())
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["config.json", "curve.png", "parties"]
    with pytest.raises(BadInput, match="not an empty folder"):
        FederatedSession(run, LEARNER, federation, tmp_path / "out").execute()
