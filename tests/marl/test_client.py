"""A party of a federation, driven from outside, and the means of several in one process."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

import marl.replicas
from marl.algorithm1 import run_algorithm
from marl.fedqmix import federation
from marl.fedqmix.client import Client, Party, ProximalNetworks, rounds_of
from marl.fedqmix.federation import average, initial_weights, require_weights
from marl.fedqmix.session import FederatedSession, federate
from marl.fedqmix.settings import (
    EngineSettings,
    FederationSettings,
    Shared,
    check_federation,
)
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
    return Shared(RUN, LEARNER, FederationSettings(), 2, len(config.uavs), len(config.devices))


@pytest.fixture
def parties(small_scene, tmp_path):
    return [Party(small_scene.folder, tmp_path / str(number), number, "segmented")
            for number in range(len(small_scene.config.uavs))]


def in_truth(shared):
    return replace(shared, run=shared.run.model_copy(update={"twin": "truth"}))


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
    means, train = [], federation.FedQMIX._train

    def seen(self, episodes):
        record, mean = train(self, episodes)
        means.append(mean)
        return record, mean

    monkeypatch.setattr(federation.FedQMIX, "_train", seen)
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


def test_the_session_makes_the_same_means_in_one_process(shared, parties):
    shared = in_truth(shared)
    first, *means = federate(shared, parties, lambda count: None)
    clients = [Client(shared.run, LEARNER, party) for party in parties]
    for number, mean in enumerate(means, 1):
        first = average([client.train(number, first)[0] for client in clients])
        for name in mean:
            np.testing.assert_array_equal(mean[name], first[name])
    assert all((party.folder / "run-in-process" / "metrics.csv").exists() for party in parties)


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
    fly_survey(small_scene, truth, flights=2, pattern="random-waypoint", seed=3).write(path)
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
    flat = {f"{group}.{name}": value for group, values in shared.config().items() if isinstance(values, dict)
            for name, value in values.items()}
    flat |= {name: getattr(shared, name) for name in ("clients", "uavs", "devices")}
    assert Shared.of(flat) == Shared(shared.run.model_copy(update={"truth": "traced", "device": "auto"}),
                                     shared.learner, shared.federation, 2, shared.uavs, shared.devices)
    for name, value, message in (("run.scene", "/etc", "not for the coordinator"), ("uavs", "3", "uavs = 3"),
                                 ("learner.hidden", 10**9, "learner.hidden"), ("run.other", 1, "run.other"),
                                 ("federation.strategy", "fedavgm", "federate-all")):
        with pytest.raises(BadInput, match=message):
            Shared.of(flat | {name: value})


def test_more_parties_than_there_are_cannot_be_needed():
    with pytest.raises(BadInput, match="--min-clients 3: there are 2"):
        check_federation(FederationSettings(min_clients=3), LEARNER, 2)


@pytest.mark.parametrize("options, status, message", [
    (["--federation", "flower", "--algorithm", "qmix"], 2, "--algorithm fedqmix"),
    (["--federation", "flower", "--resume"], 2, "without --resume"),
    (["--strategy", "fedavgm"], 2, "of a federation"),
    (["--federation", "in-process", "--min-clients", "4"], 2, "there are 2 parties"),
    (["--party-scenes", "a,b", "--strategy", "fedavgm", "--federate-all", "false"], 2, "it is Flower's"),
    (["--federation", "flower-app", "--strategy", "fedavgm"], 2, "--federate-all false"),
    (["--federation", "flower-app", "--min-clients", "4"], 2, "there are 2 parties"),
    (["--federation", "flower-app", "--party-measurements", "a,b,c", "--party-scenes", "x,y"], 2, "3 files for 2"),
    (["--federation", "flower"], 1, "extra flower"),
    (["--federation", "flower-app"], 0, "app"),
])
def test_options_that_do_not_go_together_end_with_one_message(options, status, message, small_scene, tmp_path,
                                                              monkeypatch, capsys):
    from marl.fedqmix import session
    from marl.fedqmix.__main__ import app

    monkeypatch.setattr(session, "find_spec", lambda name: None)
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
    engine = EngineSettings(party_scenes=f"{small_scene.folder},{other}")
    run = RUN.model_copy(update={"scene": small_scene.folder})
    with pytest.raises(BadInput, match="equal"):
        FederatedSession(run, LEARNER, FederationSettings(), engine, tmp_path / "out").execute()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("battery, settings, message", [
    (1.0, {}, "battery"), (40.0, {"batch": 20_000, "hidden": 4096}, "memory|at most|GiB")])
def test_what_cannot_be_trained_is_refused_before_anything_is_written(small_scene, tmp_path, battery, settings, message):
    """A battery that does not reach the terminal; a batch that no memory holds."""
    scene = tmp_path / "scene"
    shutil.copytree(small_scene.folder, scene)
    text = re.sub(r"battery = [\d.]+", f"battery = {battery}", (scene / "scene.toml").read_text())
    (scene / "scene.toml").write_text(re.sub(r"start_x_m = [\d.]+", "start_x_m = 200.0", text))
    engine = EngineSettings(party_scenes=f"{scene},{scene}")
    learner = LEARNER.model_copy(update=settings)
    with pytest.raises(BadInput, match=message):
        FederatedSession(RUN.model_copy(update={"scene": scene}), learner, FederationSettings(), engine,
                         tmp_path / "out").execute()
    assert not (tmp_path / "out").exists()


def test_a_session_in_one_process_writes_what_each_party_collects(small_scene, tmp_path, capsys):
    engine = EngineSettings(party_scenes=f"{small_scene.folder},{small_scene.folder}")
    run = RUN.model_copy(update={"scene": small_scene.folder, "twin": "truth", "real_episodes": 1, "episodes": 8})
    FederatedSession(run, LEARNER, FederationSettings(), engine, tmp_path / "out").execute()
    assert "in its truth" in " ".join(capsys.readouterr().out.split())
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["app", "config.json", "curve.png", "parties"]
    with pytest.raises(BadInput, match="not an empty folder"):
        FederatedSession(run, LEARNER, FederationSettings(), engine, tmp_path / "out").execute()


def test_the_proximal_term_is_that_of_the_paper(shared, city_mission):
    networks = ProximalNetworks(LEARNER, city_mission, 0, "cpu", mu=0.3)
    mean = {name: array + np.float32(0.25) for name, array in networks.weights().items()}
    networks.set_weights(mean)
    assert float(networks.penalty().detach()) == 0
    with torch.no_grad():
        for weight in networks.parameters():
            weight += 0.5
    count = sum(weight.numel() for weight in networks.parameters())
    assert float(networks.penalty().detach()) == pytest.approx(0.3 / 2 * 0.25 * count, rel=1e-5)
    gradients = torch.autograd.grad(networks.penalty(), networks.parameters())
    for gradient in gradients:
        torch.testing.assert_close(gradient, torch.full_like(gradient, 0.3 * 0.5), rtol=1e-5, atol=1e-6)


def test_a_large_proximal_term_holds_weights_near_the_mean(shared, parties, tmp_path):
    shared = in_truth(shared)
    mean, moved = initial_weights(shared), []
    for mu in (0.0, 1e3):
        party = Party(parties[0].scene, tmp_path / f"mu{mu}", 0, "segmented")
        weights, _ = Client(shared.run, shared.learner, party, mu).train(1, mean)
        moved.append(np.sqrt(sum(((weights[name] - mean[name]) ** 2).sum() for name in mean
                                 if name.startswith(("agent.", "mixer.")))))
    assert 0 < moved[1] < 0.7 * moved[0]
