"""Open-loop plans, replanning, and replanning with a belief when assumptions are wrong: `belief`.

    python -m studies.generated 3 runs/town && radiotwin trace runs/town
    radiotwin build-scene sionna:munich --bbox=-300,-300,300,300 --altitudes 60,65,70 --step 20
        --devices 10 --uavs 3 --seed 1 -o runs/munich && radiotwin trace runs/munich
    python -m studies belief --jobs 2

The law is learnt from the anchors of one flight in the truth: of the right form where the truth is
statistical, and of the wrong one where it is ray-traced. `positions`: unknown devices are 20 to
40 m from where map and UAVs have them. `silent`: three devices do not transmit, and the UAVs know
of each that it does not with a probability of 0.3. `both`. `volumes`: data are evenly 0 to twice
what is thought. Batteries are such that who knows all collects 0.85 to 0.95. Beside, for two seeds:
the promise of `radiotwin plan` on the same belief, and what its plan collects; and the fewest UAVs
that promise 0.9 of the data with 0.9 confidence, and what they collect.
"""

from dataclasses import replace

import numpy as np
import pandas as pd
from scipy.stats import ttest_1samp

from marl.belief import Prior
from marl.environment import Environment
from marl.flights import Policy, fly
from marl.heuristics import HeuristicPolicy
from marl.mission import Known, Mission, make_mission
from marl.planner import PlanPolicy, plan
from marl.promise import promise, sized
from marl.replanning import EVERY, ITERATIONS, ReplanPolicy
from marl.settings import stream
from marl.worlds import twin_prior
from radiotwin import Scene, Twin, fit_twin, fly_survey
from radiotwin.maps.survey import read_truth
from studies import tables
from studies.runner import Study

BATTERY = {"rbm-traced": 0.9, "rbm-segmented": 1.0, "rdm-traced": 0.95, "rdm-segmented": 1.0,
           "runs/town-traced": 0.75, "runs/town-segmented": 0.82,
           "runs/munich-traced": 1.0, "runs/munich-segmented": 1.1}
OF_SILENT = 0.85  # of the battery, where there is less to collect
OFF_M = (20.0, 40.0)  # of a device from where it is thought to be
SILENT_DB = -1000.0  # SNR between UAVs without a link
SCENARIOS = ("positions", "silent", "both", "volumes")
SILENT, SILENT_SHARE = 3, 0.3
PROMISED, WANTED, UAVS = 2, 0.9, range(1, 7)  # seeds with a promise; share and numbers of a sizing
FLIGHTS = 2  # of a method in a world
METHODS = {"fixed": "open-loop plan", "replan": "re-planning", "belief": "belief, link",
           "belief-no-link": "belief, no link", "greedy": "greedy",
           "clairvoyant": "plan by who knows all"}


def belief_cases(seed: int) -> dict[str, dict]:
    """Return every scenario in every world."""
    return {f"{world.removeprefix('runs/')}-{scenario}": {
        "world": world, "scenario": scenario, "iterations": 100_000, "promise": seed < PROMISED,
        "battery": battery * (OF_SILENT if scenario in ("silent", "both") else 1.0)}
        for scenario in SCENARIOS for world, battery in BATTERY.items()}


def fly_believing(seed: int, settings: dict) -> dict:
    """Fly every method in one world, with settings as in `belief_cases`.

    Returns:
        Share of the data of devices that transmit, for each method; `promised`: P10, P50 and P90 of
        a plan on the belief, and `kept`: what it collects; `uavs`: the fewest that promise enough
        (0: no number does), `enough`: what they collect, and `fewer`: what one UAV less collects.
    """
    name, _, truth = settings["world"].rpartition("-")
    scene, scenario = _with_battery(Scene.load(tables.scene_folder(name)),
                                    settings["battery"]), settings["scenario"]
    rng, radio_map = np.random.default_rng([seed, 17]), read_truth(scene, truth)
    twin = _learnt(scene, radio_map, seed, rng, scenario in ("positions", "both"))
    known, own_map = Known.of(twin.devices), twin.radio_map(scene)
    prior = twin_prior(twin, scene, own_map, stream(seed, "learning"),
                       SILENT_SHARE if scenario in ("silent", "both") else 0.0,
                       1.0 if scenario == "volumes" else 0.0)
    believed = make_mission(scene, own_map, known)._replace(
        shadowing_share=prior.share, shadowing_m=prior.length_m)
    real = make_mission(scene, radio_map, known)
    sends = np.ones(real.devices, dtype=bool)
    if prior.silent.any():
        sends[rng.choice(real.devices, SILENT, replace=False)] = False
        real = real._replace(snr_db=np.where(sends[None, :, None, None], real.snr_db, -np.inf)
                             .astype(np.float32))
    if prior.data_spread:
        real = real._replace(data_units=real.data_units * rng.uniform(0, 2, real.devices))
    tries, unlinked = settings["iterations"], np.array([SILENT_DB, 0.0])

    def replanned(on: bool, linked: bool = True) -> Policy:
        mission = believed if linked else believed._replace(uav_link_db=unlinked)
        return ReplanPolicy(mission, prior if on else None, linked, EVERY, ITERATIONS, tries, seed,
                            stream(seed, "planning", 1))

    waiting = real._replace(data_units=real.data_units * sends)
    policies = {
        "fixed": PlanPolicy(plan(believed, tries, seed).actions), "replan": replanned(False),
        "belief": replanned(True), "belief-no-link": replanned(True, False),
        "greedy": HeuristicPolicy("greedy", stream(seed, "decisions")),
        "clairvoyant": PlanPolicy(plan(waiting, tries, seed).actions)}
    shares: dict = {method: _share(real, sends, policy, seed)
                    for method, policy in policies.items()}
    if settings["promise"]:
        promised = promise(prior, believed, 200, tries, seed)
        shares |= {"promised": list(promised.quantiles.values()),
                   "kept": _share(real, sends, PlanPolicy(promised.plan.actions), seed)}
        shares |= _sizing(prior, believed, real, sends, tries, seed)
    return shares


def _sizing(prior: Prior, believed: Mission, real: Mission, sends: np.ndarray, tries: int,
            seed: int) -> dict:
    """Return the least sufficient number of UAVs by `promise`, and what it and one less collect."""
    fewer = np.nan
    for uavs in UAVS:
        chosen = [number % believed.uavs for number in range(uavs)]
        battery = float(believed.battery[0]) / 2
        found = promise(prior, sized(believed, chosen, battery), 200, tries // 2, seed)
        share = _share(sized(real, chosen, battery), sends, PlanPolicy(found.plan.actions), seed)
        if found.chance(WANTED) >= WANTED:
            return {"uavs": uavs, "enough": share, "fewer": fewer}
        fewer = share
    return {"uavs": 0, "enough": np.nan, "fewer": fewer}


def _share(real: Mission, sends: np.ndarray, policy: Policy, seed: int) -> float:
    flown = fly(Environment(real, FLIGHTS, stream(seed, "truth evaluation")), policy)
    return float(flown.collected.sum(axis=(1, 2)).mean() / real.data_units[sends].sum())


def _with_battery(scene: Scene, factor: float) -> Scene:
    uavs = [uav.model_copy(update={"battery": round(2 * factor * uav.battery) / 2})
            for uav in scene.config.uavs]
    return replace(scene, config=scene.config.model_copy(update={"uavs": uavs}))


def _learnt(scene: Scene, truth: object, seed: int, rng: np.random.Generator,
            is_displaced: bool) -> Twin:
    """Return a twin fitted to the anchors' links of a flight, with assumed device positions."""
    measured = fly_survey(scene, truth, flights=1, seed=seed)  # type: ignore[arg-type]
    anchors = [each.device for each in scene.config.devices if each.role == "anchor"]
    names = measured.devices["device"].to_numpy()[measured.device_index]
    twin = fit_twin(measured.select(np.isin(names, anchors)), scene, "segmented_nn",
                    seed=seed)
    devices = []
    for each, true in zip(twin.devices, scene.config.devices, strict=True):
        angle, off_m = rng.uniform(0, 2 * np.pi), rng.uniform(*OFF_M) * is_displaced
        if each.role == "unknown":
            each = replace(each, x_m=true.x_m + off_m * np.cos(angle), z_m=true.z_m,
                           y_m=true.y_m + off_m * np.sin(angle), located=True, second_mode=None,
                           credible_radius_m=OFF_M[1] * is_displaced)
        devices.append(each)
    return replace(twin, devices=devices)


def belief_table(rows: pd.DataFrame) -> str:
    """Return tables of methods, of the gap closed by a belief, and of predicted shares."""
    law = np.where(rows["name"].str.contains("-segmented-"), "law right", "law wrong")
    scenario = rows["name"].str.rpartition("-")[2]
    heads = ["rows", *METHODS.values(), "gap closed", "without link", "belief below (5 %)"]
    pooled = [_line(name, rows[law == name]) for name in ("law right", "law wrong")] + [
        _line(f"{name}, {each}", rows[(law == name) & (scenario == each)])
        for name in ("law right", "law wrong") for each in SCENARIOS]
    by_world = [_line(str(name), mine) for name, mine in rows.groupby("name", sort=True)]
    judged = rows[rows["kept"].notna()]
    (p10, _, p90), kept = np.array(judged["promised"].tolist()).T, judged["kept"].to_numpy()
    sized_rows = judged[judged["uavs"] > 0]
    promises = [
        ["plans with a promise", str(len(judged))],
        ["collect less than their P10", f"{np.mean(kept < p10):.0%}"],
        ["collect more than their P90", f"{np.mean(kept > p90):.0%}"],
        [f"missions that {UAVS[-1]} UAVs or fewer promise {WANTED:.0%} of the data, with "
         f"{WANTED:.0%} confidence", str(len(sized_rows))],
        ["of these, the fewest that promise it collect it",
         str((sized_rows["enough"] >= WANTED).sum())],
        ["of these, one UAV less would collect it, too",
         str((sized_rows["fewer"] >= WANTED).sum())]]
    return "\n\n".join([tables.markdown(["", *heads], pooled, "All worlds"),
                        tables.markdown(["promise", "found"], promises, "Promises"),
                        tables.markdown(["", *heads], by_world, "By world")])


def _line(name: str, rows: pd.DataFrame) -> list[str]:
    gap = (rows["clairvoyant"] - rows["fixed"]).mean()
    closed = [f"{(rows[method] - rows['fixed']).mean() / gap:.0%}" if gap > 0.01 else "–"
              for method in ("belief", "belief-no-link")]
    less = [METHODS[method] for method in ("fixed", "replan") if len(rows) > 2 and ttest_1samp(
        rows["belief"] - rows[method], 0, alternative="less").pvalue < 0.05]
    return [name, str(len(rows)), *(tables.number(rows[method].mean()) for method in METHODS),
            *closed, ", ".join(less) or "none"]


STUDIES = {"belief": Study("What does a belief bring in flight?", fly_believing, belief_cases,
                           belief_table, seeds=10)}
