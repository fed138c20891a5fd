"""`python -m marl.experiments`: run a study, and make its table and figures."""

import argparse
import sys
from pathlib import Path

from marl.experiments.records import Run, begun, finished
from marl.experiments.studies import STUDIES, with_settings
from radiotwin.command import exit_status
from radiotwin.console import say, show_warnings_plainly
from radiotwin.errors import BadInput

OUT, FIGURES = Path("docs/results/experiments"), Path("docs/results/figures")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status (see `exit_status`)."""
    studies = "\n".join(f"  {name:11} {study.question}" for name, study in STUDIES.items())
    parser = argparse.ArgumentParser(
        prog="python -m marl.experiments", allow_abbrev=False, formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Run a study: every finished run is a JSON file, and the table and the figures are made of these "
                    f"alone.\n\nstudies:\n{studies}\n  {'all':11} one after the other")
    parser.add_argument("name", metavar="NAME", help="of the study")
    parser.add_argument("--seeds", metavar="INTEGER", default="3", help="how many, from 0 [3]")
    parser.add_argument("--scenes", metavar="A,B", default="rbm,rdm", help="folders, or names in scenes/ [rbm,rdm]")
    parser.add_argument("--only", metavar="A,B", help="only runs whose name has one of these parts in it")
    parser.add_argument("--set", metavar="NAME=VALUE", action="append", default=[], dest="settings",
                        help="change a setting in all runs that have it; may be repeated")
    parser.add_argument("--resume", action="store_true", help="keep what is finished, go on with what was stopped")
    parser.add_argument("--report", action="store_true", help="run nothing: only make table and figures")
    parser.add_argument("--jobs", metavar="INTEGER", default="1", help="runs side by side, a core each [1]")
    parser.add_argument("--out", type=Path, default=OUT, help=f"folder of the JSON files and tables [{OUT}]")
    given = parser.parse_args(arguments)
    return exit_status(lambda: _run(given), "what is finished is kept: the same command with --resume goes on")


def _run(given: argparse.Namespace) -> None:
    show_warnings_plainly()
    if given.name not in (*STUDIES, "all"):
        raise BadInput(f"study {given.name!r} is unknown; allowed are {', '.join(STUDIES)}, all")
    seeds, jobs = _count("--seeds", given.seeds), _count("--jobs", given.jobs)
    scenes = given.scenes.split(",")
    plans: dict[str, list[Run]] = {}
    for name in STUDIES if given.name == "all" else [given.name]:
        make_runs = STUDIES[name].runs
        if make_runs is None:
            plans[name] = []
            continue
        runs = make_runs(scenes, seeds)
        if given.only:
            runs = [run for run in runs if any(part in run.name for part in given.only.split(","))]
        if not runs:
            raise BadInput(f"--only {given.only}: no run of {name} has that in its name; they are "
                           f"{', '.join(sorted({run.name for run in make_runs(scenes, 1)}))}")
        plans[name] = with_settings(runs, given.settings)
    if not given.report:  # complain before hours of work, not after them
        _check_scenes(scenes)
        for name, runs in plans.items():
            _check_resumed(name, runs, given.out, given.resume)
    for name, runs in plans.items():
        if runs and not given.report:
            from marl.experiments.work import do_runs  # torch and all: not for --help

            do_runs(runs, given.out, jobs)

        from marl.experiments.report import write_report

        figures = FIGURES if given.out == OUT else given.out / "figures"
        for path in write_report(name, STUDIES[name].question, given.out, figures):
            say(f"wrote {path}")


def _count(option: str, text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 1000:
        raise BadInput(f"{option} {text}: allowed is a whole number from 1 to 1000")
    return int(text)


def _check_resumed(study: str, runs: list[Run], out: Path, resume: bool) -> None:
    """Complain about records of other settings, and about any at all where they are not wanted."""
    done, stopped = sum(finished(run, out) for run in runs), sum(begun(run, out) for run in runs)
    if (done or stopped) and not resume:
        raise BadInput(f"{out / study} holds {done} finished runs of this study"
                       f"{' and some that were stopped' if stopped else ''}; --resume keeps them and goes on, --out "
                       "names another folder, --report only makes table and figures")


def _check_scenes(scenes: list[str]) -> None:
    """Complain about a scene that is not there."""
    from marl.experiments.learning import scene_folder
    from radiotwin.scene import Scene

    for scene in scenes:
        Scene.load(scene_folder(scene))


if __name__ == "__main__":
    sys.exit(main())
