"""`python -m marl.fedqmix`: model-aided federated QMIX (Algorithm 1 of the paper), and what it is held against."""

import argparse
import sys
from pathlib import Path

from marl.command import exit_status
from marl.options import add_options, checked
from marl.settings import PRESETS, RUNS, LearnerSettings, RunSettings, check_together
from radiotwin.command import output
from radiotwin.console import say


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status (see `exit_status`)."""
    parser = argparse.ArgumentParser(
        prog="python -m marl.fedqmix", allow_abbrev=False,
        description="Train UAVs to harvest data inside a twin that is learnt from few real flights, and judge them in "
                    "the truth. With no option: scenes/rbm, within ten minutes on two cores.")
    parser.add_argument("--out", type=Path, help="folder of the results [runs/SCENE-TRUTH-TWIN-ALGORITHM-SEED]")
    parser.add_argument("--resume", action="store_true", help="go on with a run that was stopped; same options, same "
                        "result")
    parser.add_argument("--quiet", "-q", action="store_true", help="print nothing but warnings and errors")
    parser.add_argument("--json", action="store_true", help="print the table and messages as one JSON document")
    add_options(parser, RunSettings, "run", without=set())
    add_options(parser, LearnerSettings, "learning (defaults: those of the preset fast)", without={"mix"})
    given = parser.parse_args(arguments)
    return exit_status(lambda: _run(given), "the finished rounds are kept")


def settings_of(given: argparse.Namespace) -> tuple[RunSettings, LearnerSettings]:
    """The settings that the command line names, on top of a preset's.

    Raises:
        BadInput: an impossible value.
    """
    preset = checked(given, RunSettings()).preset
    run = checked(given, RunSettings(**RUNS[preset]))
    learner = checked(given, PRESETS[preset].model_copy(update={"mix": run.algorithm != "iql"}))
    check_together(run, learner)
    return run, learner


def _run(given: argparse.Namespace) -> None:
    with output(given.quiet, given.json):
        run, learner = settings_of(given)

        from marl.session import Session  # torch and all: not for --help

        out = given.out or Path("runs") / f"{run.scene.name}-{run.truth}-{run.twin}-{run.algorithm}-{run.seed}"
        Session(run, learner, out, given.resume).execute()
        say(f"wrote {out}")


if __name__ == "__main__":
    sys.exit(main())
