"""Memory that a run would take, checked before any is taken."""

import math

from marl.features import observation_size, state_size
from marl.mission import Mission
from marl.registry import learner_class
from marl.settings import LearnerSettings, RunSettings
from radiotwin.budgets import TRAINING_BYTES

_COPIES = 4  # of the weights: target network, and two moments of the optimiser


def check_sizes(run: RunSettings, settings: LearnerSettings, mission: Mission) -> None:
    """Refuse settings that take more memory than `TRAINING_BYTES`.

    Args:
        run: settings of the run.
        settings: settings of learning.
        mission: gives the sizes.

    Raises:
        BadInput: names the option.
    """
    uavs, devices, slots = mission.uavs, mission.devices, mission.longest
    flight = slots * (4 * (uavs * devices + devices + uavs) + 9 * uavs)  # see Frame and Flights
    field = 4 * math.prod(mission.snr_db.shape[1:])  # shadowing that stays for a flight
    subject = f"{slots} slots, {uavs} UAVs and {devices} devices"
    needed = {"flights": run.flights * (flight + field)}
    if learner_class(run.algorithm).learns:
        replicas = uavs if run.algorithm == "fedqmix" else 1
        kept = min(settings.replay, run.real_episodes * run.episodes)
        width, hidden = observation_size(mission) + uavs + 6, settings.hidden
        mixer = state_size(mission) * settings.mixing_width * (uavs + 3)
        needed |= {
            "selection_flights": settings.selection_flights * (flight + field),
            "parallel": settings.parallel * (flight + field),
            "replay": replicas * kept * flight,
            "batch": settings.batch * slots * uavs * 4 * (width + 10 * hidden),
            "hidden": replicas * _COPIES * 4 * hidden * (width + 6 * hidden),
            "mixing_width": replicas * _COPIES * 4 * mixer}
    for name, size in needed.items():
        given = getattr(run if hasattr(run, name) else settings, name)
        TRAINING_BYTES.check(size, f"--{name.replace('_', '-')} {given} with {subject}")
