"""Settings of a run and of learning, which become command-line options; learners; random streams.

The names of the learners are the choices of `--algorithm`. Each purpose has an independent stream
of random numbers from one seed.
"""

import functools
import importlib
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import numpy as np
import typer
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from radiotwin.errors import BadInput
from radiotwin.runtime.command import with_options
from radiotwin.runtime.plugins import entry_points
from radiotwin.scene.folder import published_scene

LEARNERS: dict[str, Any] = {
    "fedqmix": "marl.fedqmix.federation:FedQMIX",
    "qmix": "marl.qmix:QMIX",
    "iql": "marl.qmix:IQL",
    "greedy": "marl.heuristics:Greedy",
    "heuristic": "marl.heuristics:Heuristic",
    "policy": "marl.policy:Pretrained",
    "planner": "marl.planner:Planner",
    "belief": "marl.replanning:BeliefPlanner",
    "random": "marl.heuristics:Random",
}
"""Name -> `module:class`, or the class itself; each is a `marl.learner.Learner`.

Installed packages add theirs by entry points of the group `radiotwin.learners`.
"""
PURPOSES = ("learning", "real flight", "decisions", "choice", "twin evaluation",
            "truth evaluation", "planning")
Settings = TypeVar("Settings", bound=BaseModel)


def learners() -> dict[str, Any]:
    """Return `LEARNERS` and installed packages' learners, without those of a name in `LEARNERS`."""
    others = {point.name: point.value for point in entry_points("radiotwin.learners")}
    return LEARNERS | {name: value for name, value in others.items() if name not in LEARNERS}


def learner_class(name: str) -> Any:
    """Import the class of a learner by its name."""
    found = learners()[name]
    if isinstance(found, str):
        module, _, attribute = found.partition(":")
        found = getattr(importlib.import_module(module), attribute)
    return found


class LearnerSettings(BaseModel):
    """Settings of learning. The defaults are the preset `fast`."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    hidden: int = Field(64, ge=1, le=4096, description="width of the agents' recurrent layer")
    mixing_width: int = Field(32, ge=1, le=4096, description="width of the mixing layer")
    learning_rate: float = Field(2e-3, gt=0, le=1, description="of Adam, at the start")
    last_learning_rate: float = Field(
        2e-4, ge=0, le=1, description="of Adam, at the end; linear in between")
    discount: float = Field(0.99, ge=0, le=1, description="discount per slot, gamma")
    td_lambda: float = Field(
        0.8, ge=0, le=1, description="TD(lambda): 0 looks one slot ahead, 1 to the flight's end")
    double_q: bool = Field(
        True, description="choose the target's action with the online network")
    batch: int = Field(32, ge=1, le=10_000, description="flights in an update")
    replay: int = Field(2000, ge=1, le=1_000_000, description="flights in the replay memory")
    target_every: int = Field(
        50, ge=1, le=10**9, description="updates between copies to the target network")
    episodes_per_update: int = Field(4, ge=1, le=10_000, description="flights between updates")
    parallel: int = Field(20, ge=1, le=10_000, description="flights flown side by side")
    first_epsilon: float = Field(
        1.0, ge=0, le=1, description="share of the slots that a UAV explores, at the start")
    last_epsilon: float = Field(0.05, ge=0, le=1, description="the same at the end")
    excursion_slots: float = Field(
        4.0, ge=1, le=1000, description="mean slots that exploration keeps a random action")
    epsilon_slots: int = Field(
        175_000, ge=0, le=10**12, description="slots over which the share falls linearly")
    federate_every: int = Field(
        100, ge=1, le=10**9, description="episodes of a replica between averages (fedqmix), and "
        "between evaluations of the policy")
    selection_flights: int = Field(
        64, ge=0, le=100_000, description="flights of such an evaluation, in the map that is "
        "trained in; the best policy of a round flies. 0: the last one flies")
    federate_all: bool = Field(
        True, description="average target networks and the optimiser's moments, too (fedqmix)")
    reward_scale: float = Field(
        1000.0, ge=1e-6, le=1e12, description="data units that make a reward of 1")


PRESETS = {
    "fast": LearnerSettings(),
    # Chen et al. 2023 and the code published with it; ten flights side by side and the reward's
    # scale are ours.
    "paper": LearnerSettings(
        learning_rate=5e-4, last_learning_rate=5e-4, td_lambda=0.0, double_q=False, replay=5000,
        target_every=200, episodes_per_update=1, parallel=10, excursion_slots=1.0,
        epsilon_slots=50_000, federate_every=50, selection_flights=0, federate_all=False),
}
RUNS: dict[str, dict[str, Any]] = {
    "fast": {},
    "paper": {"real_episodes": 30, "episodes": 1000, "first_flight": "random",
              "measure": "policy", "twin_shadowing": "slot"},
}
"""Settings of the run that a preset changes."""


@dataclass(frozen=True)
class Choices:
    """Annotation of a text setting whose allowed values are listed lazily."""

    values: Callable[[], list[str]]


def _registered(name: str) -> str:
    """Return the name of a learner; refuse an unknown one."""
    if name not in learners():
        *others, last = (repr(each) for each in learners())
        raise PydanticCustomError("literal_error", f"Input should be {', '.join(others)} or {last}")
    return name


class RunSettings(BaseModel):
    """Settings of a run."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    scene: Path = Field(published_scene("rbm"), description="scene folder")
    truth: Literal["traced", "segmented"] = Field(
        "traced", description="map of the real flights: SCENE/truth.nc, or the paper's "
        "statistical truth")
    twin: Literal["nn", "log-distance", "kriging", "paths", "path_kriging", "truth"] = Field(
        "nn", description="model of the twin that is trained in; paths: follows paths over the 3D "
        "map, minutes a round; path_kriging: the same over a map that may be wrong; truth: a "
        "perfect twin, in which training flights count as real ones")
    twin_shadowing: Literal["fitted", "slot"] = Field(
        "fitted", description="how long the twin's error lasts in a simulated flight: fitted to "
        "its residuals, or one slot; preset paper: slot")
    algorithm: Annotated[str, Choices(lambda: [*learners()]), AfterValidator(_registered)] = Field(
        "fedqmix", description="learner, planner or heuristic that flies")
    preset: Literal["fast", "paper"] = Field("fast", description="settings of learning")
    real_episodes: int = Field(
        10, ge=1, le=10_000, description="rounds, each with one real flight of all UAVs to learn "
        "the twin from; preset paper: 30")
    episodes: int = Field(
        800, ge=1, le=10_000_000, description="training episodes of each replica in a round; "
        "preset paper: 1000")
    first_flight: Literal["waypoints", "random"] = Field(
        "waypoints", description="the first real flight, when nothing is known: from one random "
        "cell to the next, or a random feasible action in every slot; preset paper: random")
    measure: Literal["policy", "waypoints"] = Field(
        "waypoints", description="the other real flights, which the twin is learned from: the "
        "current policy, or from one random cell to the next; preset paper: policy")
    assignment: Literal["matching", "max-rate"] = Field(
        "matching", description="matching: strongest remaining pair first; max-rate: strictly "
        "each UAV's best device")
    privileged: bool = Field(
        False, description="agents see the true positions of the unknown devices")
    compare: Literal["none", "twins", "truth"] = Field(
        "twins", description="train in other maps beside it, too, for the table: in the nn and "
        "log-distance twins; truth: also in the truth")
    planner_iterations: int = Field(
        150_000, ge=1, le=10**9, description="plans that the planner tries")
    noise_db: float = Field(
        1.0, ge=0, le=50, description="standard deviation of the receivers' measurement error; "
        "not used in a truth with shadowing")
    flights: int = Field(64, ge=1, le=100_000, description="flights of an evaluation")
    device: Literal["auto", "cpu", "cuda"] = Field(
        "auto", description="where networks are trained; auto: on a GPU if there is one. Only "
        "cpu repeats to the bit")
    seed: int = Field(0, ge=0, le=2**31, description="of all random numbers")


def check_together(learner: LearnerSettings) -> None:
    """Refuse settings of learning that are allowed one by one, but not together, BadInput."""
    if learner.batch > learner.replay or learner.parallel > learner.replay:
        raise BadInput(
            f"replay {learner.replay}: it must hold a batch ({learner.batch} flights) and what is "
            f"flown side by side ({learner.parallel}); raise it, or lower batch or parallel")


def stream(seed: int, purpose: str, number: int = 0) -> np.random.Generator:
    """Return an independent random generator for one of `PURPOSES`, by replica, flight or round."""
    # Counted from 1, since numpy treats the seeds [1, 2, 0] and [1, 2] alike.
    return np.random.default_rng([seed, PURPOSES.index(purpose) + 1, number + 1])


def with_settings(*models: type[BaseModel]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorate a command with one option for each field of some classes of settings.

    The command gets the given options as a keyword `given`: field -> text, for `checked`.
    """
    fields = {name: field for model in models for name, field in model.model_fields.items()}

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(command)
        def run(**options: Any) -> None:
            given = {name: options.pop(name) for name in fields}
            command(given={name: text for name, text in given.items() if text is not None},
                    **options)

        signature = inspect.signature(command)
        parameters = [each for each in signature.parameters.values() if each.name != "given"]
        return with_options(run, signature.replace(parameters=parameters),
                            {name: (_option(name, field), None) for name, field in fields.items()})
    return decorate


def checked(given: Mapping[str, str], defaults: Settings) -> Settings:
    """Return settings with values of the command line in place of the defaults.

    Args:
        given: field -> text; fields of other settings are ignored.
        defaults: values of the fields that are not given.

    Raises:
        BadInput: a value that is not allowed; the message names option, value and allowed values.
    """
    values = {name: given[name] for name in type(defaults).model_fields if name in given}
    try:
        return type(defaults).model_validate(defaults.model_dump() | values)
    except ValidationError as error:
        first = error.errors()[0]
        name = str(first["loc"][0])
        allowed = _allowed(type(defaults).model_fields[name])
        raise BadInput(f"{_flag(name)} {str(first['input'])[:60]}: {first['msg']}; "
                       f"allowed: {allowed}") from None


def settings_of(given: Mapping[str, str]) -> tuple[RunSettings, LearnerSettings]:
    """Return the settings of a command line: those of its preset, changed by the given options.

    Raises:
        BadInput: a value that is not allowed, or values that contradict each other.
    """
    preset = checked(given, RunSettings()).preset
    run = checked(given, RunSettings(**RUNS[preset]))
    learner = checked(given, PRESETS[preset])
    check_together(learner)
    return run, learner


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _option(name: str, field: FieldInfo) -> Any:
    """Return the annotation of a field's command-line option, for Typer."""
    default = str(field.default).lower() if isinstance(field.default, bool) else field.default
    text = field.description or ""
    return Annotated[str | None, typer.Option(
        _flag(name), metavar=_metavar(field), show_default=False,
        help=f"{text[:1].upper()}{text[1:]} [{default}].")]


def _metavar(field: FieldInfo) -> str:
    """Return the choices or the kind of a field's values, for the help."""
    if get_origin(field.annotation) is Literal:
        return "|".join(get_args(field.annotation))
    for choices in field.metadata:
        if isinstance(choices, Choices):
            return "|".join(choices.values())
    names: dict[Any, str] = {bool: "true|false", int: "INTEGER", float: "NUMBER"}
    return names.get(field.annotation, "PATH")


def _allowed(field: FieldInfo) -> str:
    """Return the allowed values of a field as text, for messages."""
    signs = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    bounds = [f"{signs[name]} {limit:g}" for bound in field.metadata for name in signs
              if (limit := getattr(bound, name, None)) is not None]
    kinds = {"INTEGER": "a whole number", "NUMBER": "a number", "PATH": "a path"}
    kind = kinds.get(_metavar(field), _metavar(field))
    return " ".join([kind, ", ".join(bounds)]).strip()
