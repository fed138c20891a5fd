"""A case: a target, and changes of its file. Cases are small JSON records, so that a failed one is kept."""

import json
import os
import random
import socket
from dataclasses import asdict, dataclass
from pathlib import Path

from tests.fuzz.mutations import Mutation, apply, names
from tests.fuzz.sandbox import Outcome, prepare_case, run_watched
from tests.fuzz.targets import TARGETS, Target

CORPUS = Path(__file__).with_name("corpus.jsonl")
# Instead of the file: links, pipes and folders where a file should be.
INSTEAD = {
    "pipe": os.mkfifo, "folder": Path.mkdir,
    "link out": lambda path: path.symlink_to(next(each for each in path.parents if each.name == "work").with_name("canary")),
    "link to a device": lambda path: path.symlink_to("/dev/zero"), "loop": lambda path: path.symlink_to(path),
    "absent": lambda path: None, "huge": lambda path: path.touch() or os.truncate(path, 2**40)}
MUTATION_COUNT = (1, 1, 1, 2, 3, 6)


@dataclass(frozen=True)
class Case:
    """A target by its file and command, and what is done to the file."""

    file: str
    command: str
    mutations: tuple[Mutation, ...] = ()
    instead: str = ""

    def dumps(self) -> str:
        """Return the case as one line of JSON."""
        return json.dumps(asdict(self))

    @property
    def target(self) -> Target:
        """Its target; of a command that is gone, one of its own."""
        return next((each for each in TARGETS if (each.file, each.command) == (self.file, self.command)),
                    Target("gone", self.file, self.command))


def loads(line: str) -> Case:
    """Return a case from one line of JSON."""
    record = json.loads(line)
    return Case(**record | {"mutations": tuple(Mutation(**each) for each in record["mutations"])})


def instead_of(target: Target) -> list[str]:
    """Return what may be put instead of a file; a file that the user names may be a link to any place."""
    named = target.file in target.command.split()
    return [kind for kind in INSTEAD if not (named and kind == "link out")]


def draw(rng: random.Random, targets: list[Target]) -> Case:
    """Draw a case."""
    target = rng.choice(targets)
    if rng.random() < 0.03 and target.suffix != ".args":
        return Case(target.file, target.command, (), rng.choice(instead_of(target)))
    kinds = names(target.suffix)
    return Case(target.file, target.command, tuple(
        Mutation(rng.choice(kinds), round(rng.random(), 6), rng.randrange(10**6)) for _ in range(rng.choice(MUTATION_COUNT))))


def listen() -> socket.socket:
    """Return a server on this machine that nothing may call."""
    listener = socket.create_server(("127.0.0.1", 0))
    listener.setblocking(False)
    return listener


def run_case(case: Case, honest: Path, folder: Path, listener: socket.socket) -> Outcome:
    """Damage a copy of the honest files, run the command and judge what it did."""
    path = prepare_case(honest, folder) / case.file
    if case.instead:
        path.unlink()
        INSTEAD[case.instead](path)
    else:
        data = path.read_bytes()
        for mutation in case.mutations:
            data = apply(mutation, data, case.target.suffix, listener.getsockname()[1])
        path.write_bytes(data)
    return run_watched(case.command, folder, listener)
