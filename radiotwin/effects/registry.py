"""Registry of effects: the built-in catalogue, those of installed packages, and registered ones.

A package adds effects under the entry-point group `radiotwin.effects`, a script with `register`.
Candidates compete by their held-out errors, so the order has no effect.
"""

from radiotwin.effects.base import Effect
from radiotwin.effects.catalogue.body_shadowing import BodyShadowing
from radiotwin.effects.catalogue.building_entry import BuildingEntry
from radiotwin.effects.catalogue.clock_offset import ReceiverClockOffset
from radiotwin.effects.catalogue.declared_sectors import DeclaredSectors, DeclaredSectorsOnPaths
from radiotwin.effects.catalogue.detection_limit import DetectionLimit
from radiotwin.effects.catalogue.episode import Episode
from radiotwin.effects.catalogue.excess_attenuation import ExcessAttenuation
from radiotwin.effects.catalogue.faulty_flight import FaultyFlight
from radiotwin.effects.catalogue.foliage import Foliage
from radiotwin.effects.catalogue.gain_drift import DeviceDrift, ReceiverDrift
from radiotwin.effects.catalogue.gain_offsets import DeviceGainOffset, ReceiverGainOffset
from radiotwin.effects.catalogue.ground_reflection import GroundReflection
from radiotwin.effects.catalogue.interference import Interference
from radiotwin.effects.catalogue.lock_loss import LockLoss
from radiotwin.effects.catalogue.mapped_vegetation import MappedVegetation
from radiotwin.effects.catalogue.missing_obstacle import MissingObstacle
from radiotwin.effects.catalogue.noise_floor import NoiseFloor
from radiotwin.effects.catalogue.path_strength import Diffraction, WallReflection
from radiotwin.effects.catalogue.position_errors import (
    DeviceMoved,
    DevicePositionError,
    ReceiverPositionError,
)
from radiotwin.effects.catalogue.receiver_saturation import ReceiverSaturation
from radiotwin.effects.catalogue.removed_obstacle import RemovedObstacle
from radiotwin.effects.catalogue.roof_heights import RoofHeights
from radiotwin.effects.catalogue.sector_antenna import SectorAntenna
from radiotwin.effects.catalogue.tilted_dipole import TiltedDipole
from radiotwin.effects.catalogue.uncertain_sight import UncertainSight
from radiotwin.effects.catalogue.unexplained_trend import UnexplainedTrend
from radiotwin.errors import BadInput
from radiotwin.runtime.plugins import load_plugins

ENTRY_POINTS = "radiotwin.effects"
BUILT_IN: tuple[type[Effect], ...] = (
    DeviceGainOffset, ReceiverGainOffset, DeviceDrift, ReceiverDrift, ReceiverSaturation,
    NoiseFloor, DetectionLimit, SectorAntenna, DeclaredSectors, DeclaredSectorsOnPaths,
    TiltedDipole, BodyShadowing, ExcessAttenuation, DevicePositionError, DeviceMoved,
    ReceiverPositionError, ReceiverClockOffset, MissingObstacle, RemovedObstacle, BuildingEntry,
    Foliage, MappedVegetation, WallReflection, Diffraction, GroundReflection, Interference,
    LockLoss, FaultyFlight, Episode, RoofHeights, UncertainSight)
LAST_RESORTS: tuple[type[Effect], ...] = (UnexplainedTrend,)  # not candidates: would fit anything

_registered: list[type[Effect]] = []


def register(effect: type[Effect]) -> type[Effect]:
    """Add an effect class to the catalogue of this process; usable as a decorator.

    Raises:
        BadInput: it is not an effect, or its name and variant are in use.
    """
    if not (isinstance(effect, type) and issubclass(effect, Effect)):
        raise BadInput(f"{effect!r} is not a subclass of radiotwin.effects.Effect")
    if effect not in _registered:
        known = {(other.name, other.variant): other for other in (*BUILT_IN, *_registered)}
        if (effect.name, effect.variant) in known:
            other = known[effect.name, effect.variant]
            raise BadInput(
                f"the effect {effect.name!r} ({effect.variant!r}) of {effect.__module__} is in "
                f"{other.__module__} already; give it another name or variant")
        _registered.append(effect)
    return effect


def catalogue() -> tuple[type[Effect], ...]:
    """List all effect classes: built-in, of installed packages, and registered.

    Warns if an effect of a package cannot be loaded, and leaves it out.
    """
    load_plugins(ENTRY_POINTS, register, "effect")
    return (*BUILT_IN, *_registered)


def trend_over(variable: str) -> Effect:
    """Return the effect of last resort: a curve over a variable of `residual_variables`."""
    return UnexplainedTrend(variable)


def effects_named(name: str) -> list[type[Effect]]:
    """List all variants of an effect; empty if none is installed."""
    return [effect for effect in (*catalogue(), *LAST_RESORTS) if effect.name == name]


def effect_named(name: str, variant: str) -> Effect:
    """Make a new instance of an effect by name and variant, as a saved fit (a twin) names them.

    Raises:
        BadInput: no effect of that name is installed, or none of that variant.
    """
    named = effects_named(name)
    for effect in named:
        if (found := effect.of_variant(variant)) is not None:
            return found
    if not set(named) <= set(LAST_RESORTS):
        raise BadInput(f"the twin has the effect {name!r} as another version of radiotwin "
                       "described it, with other parameters; run `radiotwin close-loop` again")
    known = ", ".join(sorted({effect.name for effect in catalogue()}))
    raise BadInput(f"the twin has the effect {name[:60]!r} ({variant[:60]!r}), which this version "
                   f"of radiotwin does not know; it knows {known}; an effect of a package's own "
                   "needs that package to be installed")
