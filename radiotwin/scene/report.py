"""The report on a city that was built into a scene, and its printed form."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from radiotwin.errors import BadInput
from radiotwin.runtime.console import print_table
from radiotwin.scene.checks import Problem
from radiotwin.scene.scene import Scene

_COLOURS = {"error": "bold red", "warning": "yellow", "fixed": "green"}
_TITLE: dict[str, Any] = {"title_justify": "left", "title_style": "bold"}


@dataclass(frozen=True)
class MaterialUse:
    """A material at the scene's frequency.

    Attributes:
        name: Name in `city.xml`.
        kind: `ITU` of that name, `ITU concrete`, or `own constants`.
        shapes: Number of shapes made of it.
        relative_permittivity: At the scene's frequency.
        conductivity_s_per_m: At the scene's frequency [S/m].
        in_range: False where the ITU table does not cover the frequency.
    """

    name: str
    kind: str
    shapes: int
    relative_permittivity: float
    conductivity_s_per_m: float
    in_range: bool


@dataclass(frozen=True)
class BuildReport:
    """Result of `build_scene`. Only counts and problems are set where tracing would fail.

    Attributes:
        source: As given.
        folder: Folder of the scene; None where it was only checked.
        frequency_hz: Frequency of the scene [Hz].
        shapes, triangles: Numbers written.
        extent_m: (x_min, x_max, y_min, y_max) of the lattice [m].
        tallest_m: Highest point of a building above the ground datum [m]; 0 without buildings.
        tallest: Name of its shape.
        built_fraction: Share of the extent's area under buildings.
        altitudes_m: Altitudes of the lattice [m].
        devices, uavs: Numbers placed.
        materials: Materials in use.
        problems: Errors first.
        facts: More lines, as (subject, finding).
        step_m: Step of the lattice [m].
        altitudes_given: Whether the altitudes were asked for.
        altitudes_above: What the lattice's altitudes are above: `datum` or `ground`.
    """

    source: str
    folder: Path | None
    frequency_hz: float
    shapes: int
    triangles: int
    extent_m: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    tallest_m: float = 0.0
    tallest: str = ""
    built_fraction: float = 0.0
    altitudes_m: tuple[float, ...] = ()
    devices: int = 0
    uavs: int = 0
    materials: tuple[MaterialUse, ...] = ()
    problems: tuple[Problem, ...] = ()
    facts: tuple[tuple[str, str], ...] = ()
    step_m: float = 0.0
    altitudes_given: bool = False
    altitudes_above: str = "datum"

    @property
    def tracing_would_fail(self) -> bool:
        """Whether there is an error among the problems."""
        return any(problem.severity == "error" for problem in self.problems)

    def load_scene(self) -> Scene:
        """Load the scene that was written.

        Raises:
            BadInput: it was only checked.
        """
        if self.folder is None:
            raise BadInput(f"{self.source} was only checked, no scene was written; build it "
                           "without check_only")
        return Scene.load(self.folder)


def print_report(report: BuildReport, console: Console) -> None:
    """Print the report as tables, the problems last.

    Args:
        report: Report to print.
        console: Where to print it.
    """
    facts = Table(title="Scene from " + escape(report.source), show_header=False, **_TITLE)
    facts.add_column()
    facts.add_column(overflow="fold")
    facts.add_row("shapes, triangles", f"{report.shapes:,}, {report.triangles:,}")
    if report.altitudes_m:
        x_min, x_max, y_min, y_max = report.extent_m
        sides = f"x {x_min:g} … {x_max:g}, y {y_min:g} … {y_max:g}"
        facts.add_row("extent", f"{x_max - x_min:.5g} × {y_max - y_min:.5g} m   ({sides})")
        tallest = f"{report.tallest_m:.1f} m   ({report.tallest})" if report.tallest else "none"
        facts.add_row("tallest building", tallest)
        facts.add_row("built fraction", f"{report.built_fraction:.1%}")
        altitudes = ", ".join(f"{altitude:g}" for altitude in report.altitudes_m)
        above = "" if report.altitudes_above == "datum" else f" above the {report.altitudes_above}"
        how = "" if report.altitudes_given else "   (from 10 m above 95 % of the roofs)"
        facts.add_row("lattice altitudes", f"{altitudes} m{above}{how}")
        if report.step_m:
            facts.add_row("lattice step", f"{report.step_m:g} m")
        facts.add_row("devices, UAVs", f"{report.devices}, {report.uavs}")
    for subject, finding in report.facts:
        facts.add_row(subject, escape(finding))
    print_table(facts, console)
    if report.materials:
        print_table(_material_table(report), console)
    console.print(_problem_table(report) if report.problems else "No problems found.")


def _problem_table(report: BuildReport) -> Table:
    table = Table(title="Problems", show_header=False, show_lines=True, **_TITLE)
    table.add_column()
    table.add_column(overflow="fold")
    for problem in report.problems:
        table.add_row(Text(problem.severity, style=_COLOURS[problem.severity]),
                      Text(problem.message))
    return table


def _material_table(report: BuildReport) -> Table:
    table = Table(title=f"Materials at {report.frequency_hz / 1e9:g} GHz", **_TITLE)
    table.add_column("material", overflow="fold")
    table.add_column("kind", overflow="fold")
    for heading in ("shapes", "relative permittivity", "conductivity [S/m]"):
        table.add_column(heading, justify="right", overflow="fold")
    for use in report.materials:
        table.add_row(use.name, use.kind + ("" if use.in_range else " (out of range)"),
                      f"{use.shapes:,}", f"{use.relative_permittivity:.3f}",
                      f"{use.conductivity_s_per_m:.4g}")
    return table
