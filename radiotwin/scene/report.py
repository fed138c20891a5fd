"""What was found in a city, and its printed form."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from radiotwin.scene.problems import Problem

_COLOURS = {"error": "bold red", "warning": "yellow", "fixed": "green"}
_TITLE: dict[str, Any] = {"title_justify": "left", "title_style": "bold"}


@dataclass(frozen=True)
class MaterialUse:
    """A material at the scene's frequency.

    Attributes:
        name: in `city.xml`.
        kind: `ITU` of that name, `ITU concrete`, or `own constants`.
        shapes: how many shapes are made of it.
        relative_permittivity, conductivity_s_per_m: at the scene's frequency.
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
    """Result of `build_scene`.

    Attributes:
        source: as given.
        folder: where the scene was written; None where it was only checked.
        frequency_hz: of the scene [Hz].
        shapes, triangles: as written.
        extent_m: (x_min, x_max, y_min, y_max) of the lattice [m].
        tallest_m: highest point of a building above the ground datum [m]; 0 without buildings.
        tallest: name of its shape.
        built_fraction: share of the extent's area under buildings.
        altitudes_m: of the lattice [m].
        devices, uavs: how many were placed.
        materials: in use.
        problems: errors first.
        facts: more lines, as (what, finding).
    """

    source: str
    folder: Path | None
    frequency_hz: float
    shapes: int
    triangles: int
    extent_m: tuple[float, float, float, float]
    tallest_m: float
    tallest: str
    built_fraction: float
    altitudes_m: tuple[float, ...]
    devices: int
    uavs: int
    materials: tuple[MaterialUse, ...]
    problems: tuple[Problem, ...]
    facts: tuple[tuple[str, str], ...] = ()

    @property
    def tracing_would_fail(self) -> bool:
        return any(problem.severity == "error" for problem in self.problems)


def print_report(report: BuildReport, console: Console) -> None:
    """Print the report as tables, the problems last."""
    facts = Table(title="Scene from " + escape(report.source), show_header=False, **_TITLE)
    facts.add_row("shapes, triangles", f"{report.shapes:,}, {report.triangles:,}")
    if report.altitudes_m:
        x_min, x_max, y_min, y_max = report.extent_m
        sides = f"x {x_min:g} … {x_max:g}, y {y_min:g} … {y_max:g}"
        facts.add_row("extent", f"{x_max - x_min:.5g} × {y_max - y_min:.5g} m   ({sides})")
        tallest = f"{report.tallest_m:.1f} m   ({report.tallest})" if report.tallest else "none"
        facts.add_row("tallest building", tallest)
        facts.add_row("built fraction", f"{report.built_fraction:.1%}")
        altitudes = ", ".join(f"{altitude:g}" for altitude in report.altitudes_m)
        facts.add_row("lattice altitudes", altitudes + " m   (from 10 m above 95 % of the roofs)")
        facts.add_row("devices, UAVs", f"{report.devices}, {report.uavs}")
    for what, finding in report.facts:
        facts.add_row(what, escape(finding))
    console.print(facts)
    if report.materials:
        console.print(_material_table(report))
    console.print(_problem_table(report) if report.problems else "No problems found.")


def _problem_table(report: BuildReport) -> Table:
    table = Table(title="Problems", show_header=False, show_lines=True, **_TITLE)
    for problem in report.problems:
        table.add_row(Text(problem.severity, style=_COLOURS[problem.severity]), Text(problem.message))
    return table


def _material_table(report: BuildReport) -> Table:
    table = Table(
        title=f"Materials at {report.frequency_hz / 1e9:g} GHz", title_justify="left", title_style="bold"
    )
    for heading, justify in (
        ("material", "left"),
        ("kind", "left"),
        ("shapes", "right"),
        ("relative permittivity", "right"),
        ("conductivity [S/m]", "right"),
    ):
        table.add_column(heading, justify=justify)  # type: ignore[arg-type]  # one of Rich's words
    for use in report.materials:
        mark = "" if use.in_range else " (out of range)"
        table.add_row(
            use.name,
            use.kind + mark,
            f"{use.shapes:,}",
            f"{use.relative_permittivity:.3f}",
            f"{use.conductivity_s_per_m:.4g}",
        )
    return table
