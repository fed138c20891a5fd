"""Names of the learners, the choices of `--algorithm`; each is imported when it is used."""

import importlib
from typing import Any

from radiotwin.errors import BadInput

LEARNERS: dict[str, Any] = {
    "fedqmix": "marl.fedqmix.federation:FedQMIX",
    "qmix": "marl.qmix:QMIX",
    "iql": "marl.iql:IQL",
    "greedy": "marl.heuristics:Greedy",
    "planner": "marl.planner:Planner",
    "random": "marl.heuristics:Random",
}
"""Name -> `module:class`, or the class itself; each is a `marl.learner.Learner`."""


def learner_class(name: str) -> Any:
    """Return the class of a learner.

    Args:
        name: a key of `LEARNERS`.

    Raises:
        BadInput: no learner has this name.
    """
    if name not in LEARNERS:
        raise BadInput(f"algorithm {name!r} is unknown; allowed are {', '.join(LEARNERS)}")
    found = LEARNERS[name]
    if isinstance(found, str):
        module, _, attribute = found.partition(":")
        found = getattr(importlib.import_module(module), attribute)
    return found
