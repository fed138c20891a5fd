"""Scene folders: the city as it stands, for the tracer, and as a map shows it, for the user."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from radiotwin.scene.config import Extent, LatticeConfig, RadioConfig, SceneConfig, write_config
from radiotwin.scene.materials import Material, permittivity
from tests.undeclared.foreign.layouts import GROUND, Building
from tests.undeclared.foreign.worlds import World
from tests.undeclared.shapes import write_prisms

MARGIN_M = 60.0  # of ground around the extent
WALLS = ("concrete", "brick", "wood", "glass", "plasterboard", "marble", "metal")


def write_truth(folder: Path, where: World) -> Path:
    """Write the city as it stands; return the path of `city.xml`.

    Constants of materials are off by up to a third, some materials are others, slabs are 0.05 to
    0.5 m thick, and walls scatter.
    """
    rng = np.random.default_rng([where.city.number, where.number, 8])
    is_other = rng.random(len(where.true)) < rng.uniform(0, 0.3)
    others = rng.choice(WALLS, len(where.true))
    standing = [(one, str(others[index]) if is_other[index] else one.material)
                for index, one in enumerate(where.true) if one is not None]
    names = sorted({name for _, name in standing} | {GROUND})
    materials = {name: _real(name, where, rng) for name in names}
    write_prisms(folder, where.city.side_m, MARGIN_M, [(one, materials[name]) for one, name in standing], materials[GROUND])
    return folder / "city.xml"


def write_map(folder: Path, where: World, limit_db: float, but: Sequence[int] = (), gone: Sequence[Building] = ()) -> None:
    """Write the scene folder that a user has; without the buildings `but`, which stand, and with those that are `gone`.

    `limit_db` is the declared limit of detection [dB], or [dBm] where levels are in dBm.
    """
    buildings = [one for index, one in enumerate(where.city.buildings) if where.mapped[index] and index not in but]
    buildings = sorted([*buildings, *gone], key=lambda one: float(one.footprint_m[0, 0]))  # numbers tell nothing
    write_prisms(folder, where.city.side_m, MARGIN_M,
                 [(one, Material(one.material, itu=one.material)) for one in buildings], Material(GROUND, itu=GROUND))
    top_m = float(np.ceil(max(40.0, where.campaign.points_m[:, 2].max())))
    write_config(SceneConfig(
        name="city", radio=RadioConfig(frequency_hz=where.frequency_hz, sensitivity_dbm=round(limit_db, 1)),
        extent=Extent(x_min_m=0, x_max_m=where.city.side_m, y_min_m=0, y_max_m=where.city.side_m),
        lattice=LatticeConfig(step_m=20, altitudes_m=[top_m]), provenance={"generator": "a survey"},
    ), folder / "scene.toml")


def _real(name: str, where: World, rng: np.random.Generator) -> Material:
    relative, conductivity, _ = permittivity(name, where.frequency_hz)
    scattering = where.settings.scattering * (0.5 if name == GROUND else float(rng.uniform(0.6, 1.3)))
    return Material(f"{name}-real", relative_permittivity=max(1.0, float(relative * rng.uniform(0.67, 1.33))),
                    conductivity_s_per_m=float(conductivity * np.exp(rng.uniform(-0.7, 0.7))),
                    thickness_m=float(rng.uniform(0.05, 0.5)), scattering_coefficient=min(scattering, 0.6),
                    xpd_coefficient=0.1)
