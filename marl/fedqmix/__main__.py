"""`python -m marl.fedqmix`: Algorithm 1 of the paper with any learner, and a comparison."""

from radiotwin import signals

if __name__ == "__main__":
    signals.handle()  # before anything that takes time

from pathlib import Path
from typing import Annotated

import typer

from marl.options import settings_of, with_settings
from marl.settings import LearnerSettings, RunSettings
from radiotwin.command import with_output_options
from radiotwin.console import say, show_warnings_plainly
from radiotwin.exits import exit_status


@with_settings(RunSettings, LearnerSettings)
def fedqmix(
    given: dict[str, str],
    out: Annotated[Path | None, typer.Option(
        help="Folder of the results [runs/SCENE-TRUTH-TWIN-ALGORITHM-SEED].")] = None,
    resume: Annotated[bool, typer.Option(
        "--resume", help="Go on with a run that was stopped; same options, same result.")] = False,
) -> None:
    """Train UAVs to harvest data inside a twin learned from few real flights; judge in the truth.

    With no option: scenes/rbm, within ten minutes on two cores. In brackets: the default, which
    is that of the preset fast.
    """
    show_warnings_plainly()
    run, learner = settings_of(given)

    from marl.session import Session  # torch and all: not for --help

    name = f"{run.scene.name}-{run.truth}-{run.twin}-{run.algorithm}-{run.seed}"
    folder = out or Path("runs") / name
    Session(run, learner, folder, resume).execute()
    say(f"wrote {folder}")


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None,
                  context_settings={"help_option_names": ["-h", "--help"]})
app.command()(with_output_options(fedqmix, prints_tables=True))


if __name__ == "__main__":
    signals.leave(exit_status(app, "the finished rounds are kept: the same command with --resume "
                                   "goes on"))
