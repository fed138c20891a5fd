"""The command that plans flights: plan."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import radiotwin as rt
from radiotwin.cli.options import MAX_SEED, SceneOption, parse_numbers
from radiotwin.io.files import atomic_folder, require_folder
from radiotwin.io.inputs import keep_inputs
from radiotwin.runtime.console import print_rows, progress, result, say

if TYPE_CHECKING:
    from marl.plan_flights import PlannedFlights


def plan(
    twin: Annotated[Path, typer.Argument(
        metavar="TWIN", help="Folder of a twin, as `fit` or `close-loop` makes it.")],
    scene: SceneOption,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the plan.")] = Path("plan"),
    uavs: Annotated[int | None, typer.Option(
        min=1, max=100, help="Number of UAVs: copies of the scene's, in turn [those of the "
                             "scene].")] = None,
    battery: Annotated[float | None, typer.Option(
        min=0.5, max=10_000.0, help="Battery of each UAV in moves; a hover costs half of one [that "
                                    "of the scene].")
        ] = None,
    base: Annotated[str | None, typer.Option(
        metavar="X,Y", help="Where all UAVs start and end [m] [start and terminal in the "
                            "scene].")] = None,
    data: Annotated[Path | None, typer.Option(
        metavar="TABLE", help="Table with columns device and data_units: the data that wait at "
                              "each [data_units of the scene].")] = None,
    silent: Annotated[float, typer.Option(
        min=0.0, max=0.99, help="Probability that a device does not transmit.")] = 0.0,
    data_spread: Annotated[float, typer.Option(
        min=0.0, max=1.0, help="Data are evenly from (1 - this) to (1 + this) times what is "
                               "given.")] = 0.0,
    no_fly: Annotated[Path | None, typer.Option(
        metavar="FILE.geojson", help="Areas that no UAV may fly over.")] = None,
    clearance_m: Annotated[float, typer.Option(
        min=0.0, max=1000.0, help="Distance that UAVs keep from buildings.")] = 5.0,
    sizes: Annotated[bool, typer.Option(
        "--sizes", help="Also find how many UAVs, with which battery and from which base, collect "
                        "the wanted share.")] = False,
    wanted: Annotated[float, typer.Option(
        min=0.01, max=1.0, help="Share of the data that is wanted.")] = 0.95,
    confidence: Annotated[float, typer.Option(
        min=0.5, max=0.99, help="Share of the worlds in which it has to be collected.")] = 0.9,
    worlds: Annotated[int, typer.Option(
        min=20, max=10_000, help="Worlds that the plan is flown in.")] = 200,
    iterations: Annotated[int, typer.Option(
        min=1, max=10_000_000, help="Plans that a search tries.")] = 20_000,
    seed: Annotated[int, typer.Option(min=0, max=MAX_SEED, help="Of all random numbers.")] = 0,
) -> None:
    """Plan flights that collect the data of a twin's devices, with the share they will collect.

    The plan is flown in worlds that the twin holds possible. In nine of ten of them at least the
    share P10 is collected.
    """
    from marl.plan_flights import PlanSettings, plan_flights
    from marl.plan_output import FILES, write_plan
    from radiotwin.coverage.areas import read_areas

    require_folder(out, FILES, mark="plan.json")
    world, model = rt.Scene.load(scene), rt.Twin.load(twin)
    keep_inputs(out, data, no_fly, world.folder, twin)
    xy_m = None if base is None else parse_numbers("--base", base, 2)
    settings = PlanSettings(
        uavs=uavs, battery=battery, base_m=(xy_m[0], xy_m[1]) if xy_m else None, data=data,
        silent=silent, data_spread=data_spread, clearance_m=clearance_m, sizes=sizes, wanted=wanted,
        areas=[each.outline for each in read_areas(no_fly, world)] if no_fly else [],
        worlds=worlds, iterations=iterations, seed=seed)
    with progress("planning", total=100) as advance:
        planned = plan_flights(model, world, settings, advance)
    with atomic_folder(out) as folder:
        written = write_plan(folder, planned, wanted,
                             {"twin": str(twin), "scene": world.config.name, "seed": seed})
    _show(planned, wanted, confidence)
    if world.config.origin is None:
        say("note: the scene has no [origin], so flights are in its x and y alone (flights.csv)")
    say(f"wrote {out}: {', '.join(sorted(written))}")


def _show(planned: "PlannedFlights", wanted: float, confidence: float) -> None:
    """Print the share of data that is collected, in all and by device, and fleet sizes tried."""
    from marl.promise import smallest
    from radiotwin.display import count

    promised = planned.promised
    record = promised.record([each.device for each in planned.scene.config.devices],
                             planned.prior.silent)
    columns = {"device": "left", "P10": "right", "P50": "right", "P90": "right"}
    rows = [[name, *(("–",) * 3 if share is None else (f"{value:.3f}" for value in share.values()))]
            for name, share in (
                ("all data", record["share"]), *((each["device"], each["share"])
                                                 for each in record["devices"]))]
    print_rows(f"Share collected, in {len(promised.share)} worlds that the twin holds possible",
               columns, rows)
    for name, value in record["share"].items():
        result(f"share_{name}", value)
    if not planned.sizes:
        return
    print_rows(f"Share collected by UAVs and battery, and worlds with at least {wanted:.0%}",
               {"UAVs": "right", "battery": "right", "base": "left", "P10": "right", "P50": "right",
                "P90": "right", "worlds": "right"},
               [[row.uavs, f"{row.battery:g}", row.base, f"{row.p10:.3f}", f"{row.p50:.3f}",
                 f"{row.p90:.3f}", f"{row.chance:.0%}"] for row in planned.sizes])
    enough = smallest(planned.sizes, confidence)
    say(f"no size tried collects {wanted:.0%} in {confidence:.0%} of the worlds: more UAVs "
        "(--uavs) or larger batteries (--battery) are needed" if enough is None else
        f"{wanted:.0%} in {confidence:.0%} of the worlds needs {count(enough.uavs, 'UAV')} with "
        f"a battery of {enough.battery:g} moves, base {enough.base}")
