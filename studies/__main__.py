"""`python -m studies`: run a study, or remake tables and figures from the rows that are kept."""

from pathlib import Path
from typing import Annotated

import typer

from radiotwin.cli.console import complain, say, show_warnings_plainly
from radiotwin.errors import BadInput

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
    from studies.runner import MODULES, load_study, missing_rows, read_rows, run_rows
    from studies.tables import scene_folder

    show_warnings_plainly()
    try:
        if list_:
            for each in MODULES:
                study = load_study(each)
                say(f"{each:11} {study.question} ({len(study.cases(0))} rows, {study.seeds} seeds)")
            say("guard       Does a change keep results? (python studies/guard.py --help)")
            return
        if not report:
            if name is None:
                raise BadInput("no study is named; `python -m studies --list` shows them")
            kept = len(read_rows(name, out))
            todo = missing_rows(name, seeds or load_study(name).seeds, only, out)
            if kept and not resume:
                raise BadInput(f"{out / name}.json holds {kept} finished rows; --resume keeps "
                               "them, --out names another folder, --report runs nothing")
            scenes = {settings["scene"] for _, _, settings in todo if "scene" in settings}
            absent = sorted(each for each in scenes if not scene_folder(each).is_dir())
            if absent:
                raise BadInput(f"no scene {', '.join(absent)}: docs/results.md says where they are "
                               "from; --only chooses rows without them")
            for row in run_rows(name, todo, out, jobs):
                say(f"{name} {row['name']} seed {row['seed']}: {row['cpu_s']:.0f} CPU s")
        for each in [name] if name else MODULES:
            _report(each, out, required=name is not None)
    except BadInput as error:
        complain(str(error))
        raise typer.Exit(2) from None
    except KeyboardInterrupt:
        complain("interrupted; finished rows are kept: the same command with --resume goes on")
        raise typer.Exit(130) from None


def _report(name: str, out: Path, required: bool) -> None:
    from radiotwin.files import atomic_path
    from studies.runner import load_study, read_rows
    from studies.tables import provenance, read_frame

    study, rows = load_study(name), read_rows(name, out)
    if not rows and required:
        raise BadInput(f"{out / name}.json holds no finished row; run the study first")
    if not rows:
        return
    text = f"# {study.question}\n\n`python -m studies {name}`. {provenance(rows)}\n\n" \
           f"{study.table(read_frame(rows))}\n"
    with atomic_path(out / f"{name}.md") as temporary:
        temporary.write_text(text, encoding="utf-8")
    say(f"wrote {out / name}.md")
    for title, figure in study.figures(read_frame(rows)).items():
        with atomic_path(out / "figures" / f"{title}.png") as temporary:
            figure.savefig(temporary, dpi=figure.dpi)
        say(f"wrote {out / 'figures' / title}.png")


if __name__ == "__main__":
    app()
