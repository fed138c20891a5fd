"""`python -m studies`: run a study, or remake tables and figures from the rows that are kept."""

from pathlib import Path
from typing import Annotated

import typer

from radiotwin.errors import BadInput, RunFailed
from radiotwin.io.files import atomic_path
from radiotwin.runtime.console import complain, say, show_warnings_plainly
from studies import runner

Flag = typer.Option
app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.command()
def main(
    name: Annotated[str | None, typer.Argument(help="Study; with --report all of them.")] = None,
    list_: Annotated[bool, Flag("--list", help="List the studies.")] = False,
    report: Annotated[bool, Flag("--report", help="Only remake tables and figures.")] = False,
    seeds: Annotated[int | None, Flag(min=1, max=1000, help="How many, from 0.")] = None,
    only: Annotated[str | None, Flag(metavar="A,B", help="Parts of names, or NAME:SEED.")] = None,
    resume: Annotated[bool, Flag("--resume", help="Keep finished rows, run the others.")] = False,
    jobs: Annotated[int, Flag(min=1, max=1000, help="Processes, one row each.")] = 1,
    out: Annotated[Path, Flag(help="Folder of rows, tables and figures.")] = Path("docs/results"),
) -> None:
    """Run a study: each row is kept as soon as it is finished."""
    show_warnings_plainly()
    try:
        if list_:
            for each in runner.MODULES:
                study = runner.load_study(each)
                say(f"{each:11} {study.question} ({len(study.cases(0))} rows, {study.seeds} seeds)")
            say("guard       Does a change keep results? (python studies/guard.py --help)")
            return
        if not report:
            if name is None:
                raise BadInput("no study is named; `python -m studies --list` shows them")
            run(name, seeds or runner.load_study(name).seeds, only, resume, jobs, out)
        for each in [name] if name else runner.MODULES:
            write_report(each, out, required=name is not None)
    except BadInput as error:
        complain(str(error))
        raise typer.Exit(2) from None
    except RunFailed as error:
        complain(f"{error}; finished rows are kept: the same command with --resume goes on")
        raise typer.Exit(1) from None
    except KeyboardInterrupt:
        complain("interrupted; finished rows are kept: the same command with --resume goes on")
        raise typer.Exit(130) from None


def run(name: str, seeds: int, only: str | None, resume: bool, jobs: int, out: Path) -> None:
    """Run the rows that a study lacks."""
    from studies.tables import scene_folder

    kept, todo = runner.read_rows(name, out), runner.missing_rows(name, seeds, only, out)
    if kept and not resume:
        raise BadInput(f"{out / name}.json holds {len(kept)} finished rows; --resume keeps them, "
                       "--out names another folder, --report runs nothing")
    scenes = {settings["scene"] for _, _, settings in todo if "scene" in settings}
    absent = sorted(each for each in scenes if not scene_folder(each).is_dir())
    if absent:
        raise BadInput(f"no scene {', '.join(absent)}: docs/results.md says where they are from; "
                       "--only chooses rows without them")
    runner.run_rows(name, todo, out, jobs, lambda row: say(
        f"{name} {row['name']} seed {row['seed']}: {row['cpu_s']:.0f} CPU s"))


def write_report(name: str, out: Path, required: bool) -> None:
    """Write the table and the figures of a study, if it has rows."""
    from studies.tables import provenance, read_frame

    study, rows = runner.load_study(name), runner.read_rows(name, out)
    if not rows:
        if required:
            raise BadInput(f"{out / name}.json holds no finished row; run the study first")
        return
    text = f"# {study.question}\n\n`python -m studies {name}`. {provenance(rows)}\n\n" \
           f"{study.table(read_frame(rows))}\n"
    with atomic_path(out / f"{name}.md") as temporary:
        temporary.write_text(text, encoding="utf-8")
    for title, figure in study.figures(read_frame(rows)).items():
        with atomic_path(out / "figures" / f"{title}.png") as temporary:
            figure.savefig(temporary, dpi=figure.dpi)
    say(f"wrote {out / name}.md")


if __name__ == "__main__":
    app()
