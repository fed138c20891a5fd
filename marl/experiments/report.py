"""Tables and figures of a study, from its JSON files alone."""

from pathlib import Path

import numpy as np

from marl.environment import Frame
from marl.experiments import plots, tables
from marl.experiments.closeloop import FILES, RESULTS, closeloop_table
from marl.experiments.learning import scene_folder
from marl.experiments.records import read_study
from marl.figures import save, trajectories_figure
from marl.flights import Flights
from marl.mission import Known, make_mission
from radiotwin.errors import BadInput
from radiotwin.files import atomic_path
from radiotwin.scene import Scene
from radiotwin.survey import segmented_truth

TABLES = {"curve": tables.curve_table, "federation": tables.federation_table, "twin": tables.twin_table,
          "quality": tables.quality_table, "pays": tables.pays_table, "tuning": tables.tuning_table}
FIGURES = {"curve": plots.curve_figure, "federation": plots.federation_figure, "twin": plots.twin_figure,
           "quality": plots.quality_figure, "pays": plots.pays_figure}

FIGURE_DPI, TRAJECTORY_DPI = 100, 80  # so that no picture has more than 200 kB


def write_report(study: str, question: str, out: Path, figures: Path) -> list[Path]:
    """Write OUT/STUDY.md and the study's figures.

    Args:
        study: its name.
        question: that it answers.
        out: folder of the records.
        figures: folder of the pictures.

    Returns:
        the files

    Raises:
        BadInput: there is no finished run.
    """
    path = out / f"{study}.md"
    head = f"# {question}\n\n`python -m marl.experiments {study}`. "
    if study == "closeloop":
        missing = [name for name in FILES if not (RESULTS / name).is_file()]
        if missing:
            raise BadInput(f"{RESULTS / missing[0]} is not there; start this in the root of the repository")
        return [_write(path, head + "From the JSON files in `docs/results`.\n\n" + closeloop_table() + "\n")]
    records = read_study(study, out)
    if not records:
        raise BadInput(f"{out / study} holds no finished run; run the study without --report first")
    written = [_write(path, f"{head}{tables.provenance(records)}\n\n{TABLES[study](records)}\n")]
    if study in FIGURES:
        written.append(figures / f"{study}.png")
        save(FIGURES[study](records), written[-1], FIGURE_DPI)
    if study == "curve":
        written += _trajectories(records, figures)
    return written


def _write(path: Path, text: str) -> Path:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def _trajectories(records: list[dict], figures: Path) -> list[Path]:
    """The flights of model-aided FedQMIX, seed 0, in the ray-traced truth."""
    written = []
    for record in records:
        run = record["settings"]["run"]
        if record["name"].endswith("-traced-fedqmix-nn") and record["seed"] == 0 and "flight" in record:
            scene = Scene.load(scene_folder(run["scene"]))
            known = Known({name: tuple(place_m) for name, place_m in record["known_m"].items()})
            mission = make_mission(scene, segmented_truth(scene), known)
            written.append(figures / f"trajectories-{scene.config.name}.png")
            save(trajectories_figure(scene, mission, _flight(record["flight"], mission.devices, mission), 0, known),
                 written[-1], TRAJECTORY_DPI)
    return written


def _flight(kept: dict, devices: int, mission) -> Flights:
    """The flight of a record; what the picture does not show is left empty."""
    cell, battery, assigned, collected = (np.array(kept[name])[None] for name in
                                          ("cell", "battery", "assigned", "collected"))
    slots = cell.shape[1]
    left = np.broadcast_to(mission.data_units, (1, slots, devices))
    frames = Frame(cell, battery, np.zeros((1, slots, mission.uavs, devices)), left, assigned)
    return Flights(frames, np.zeros(assigned.shape, np.int8), collected, np.array([slots], dtype=np.int32))
