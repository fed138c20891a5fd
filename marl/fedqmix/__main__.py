"""`python -m marl.fedqmix`: Algorithm 1 of the paper with any learner, and a comparison."""

from radiotwin.io import signals

if __name__ == "__main__":
    signals.handle()  # before anything that takes time

from pathlib import Path
from typing import Annotated

import typer

from marl.fedqmix.settings import FederationSettings
from marl.settings import LearnerSettings, RunSettings, checked, settings_of, with_settings
from radiotwin.errors import BadInput, optional_package
from radiotwin.runtime.command import exit_status, with_output_options
from radiotwin.runtime.console import say, show_warnings_plainly


@with_settings(RunSettings, LearnerSettings, FederationSettings)
def fedqmix(
    given: dict[str, str],
    out: Annotated[Path | None, typer.Option(
        help="Folder of the results [runs/SCENE-TRUTH-TWIN-ALGORITHM-SEED].")] = None,
    resume: Annotated[bool, typer.Option(
        "--resume", help="Go on with a run that was stopped; same options, same result.")] = False,
    seeds: Annotated[int, typer.Option(
        min=1, max=1000, help="Runs with as many seeds, from --seed on, and their interquartile "
        "means with bands [1].", show_default=False)] = 1,
) -> None:
    """Train UAVs to harvest data inside a twin learned from few real flights; judge in the truth.

    With no option: scenes/rbm, about five minutes on two cores. In brackets: the default, which
    is that of the preset fast.
    """
    show_warnings_plainly()
    for package in ("torch", "tensorboard"):
        optional_package(package, f"training needs {package}, which is not installed; install it "
                                  "with `pip install 'radiotwin[train]'`")
    run, learner = settings_of(given)
    federation = checked(given, FederationSettings())
    name = f"{run.scene.name}-{run.truth}-{run.twin}-{run.algorithm}-{run.seed}"
    folder = out or Path("runs") / name
    if not given.keys() & FederationSettings.model_fields.keys():  # one owner of all
        if seeds == 1:
            from marl.session import Session  # torch and all: not for --help

            Session(run, learner, folder, resume).execute()
        else:
            from marl.seeds import run_seeds

            run_seeds(run, learner, folder, resume, seeds)
    else:
        if run.algorithm != "fedqmix" or resume or seeds > 1:
            raise BadInput("parties of a federation train with --algorithm fedqmix and without "
                           "--resume and --seeds; leave out --federation, --party-scenes and "
                           "--party-measurements, or that")
        from marl.fedqmix.session import FederatedSession

        FederatedSession(run, learner, federation, folder).execute()
    say(f"wrote {folder}")


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None,
                  context_settings={"help_option_names": ["-h", "--help"]})
app.command()(with_output_options(fedqmix, prints_tables=True))


if __name__ == "__main__":
    signals.leave(exit_status(app, "rounds that had finished are kept: the same command with "
                                   "--resume goes on (a federation starts anew, with another "
                                   "--out)"))
