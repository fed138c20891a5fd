"""The catalogue: what a model of the channel may lack. One file per effect."""

from radiotwin.effects.base import Effect
from radiotwin.effects.body_shadowing import BodyShadowing
from radiotwin.effects.clock_offset import ReceiverClockOffset
from radiotwin.effects.detection_limit import DetectionLimit
from radiotwin.effects.excess_attenuation import ExcessAttenuation
from radiotwin.effects.foliage import Foliage
from radiotwin.effects.gain_drift import DeviceDrift, ReceiverDrift
from radiotwin.effects.gain_offsets import DeviceGainOffset, ReceiverGainOffset
from radiotwin.effects.ground_reflection import GroundReflection
from radiotwin.effects.interference import Interference
from radiotwin.effects.lock_loss import LockLoss
from radiotwin.effects.missing_obstacle import MissingObstacle
from radiotwin.effects.noise_floor import NoiseFloor
from radiotwin.effects.paths import Diffraction, WallReflection
from radiotwin.effects.position_errors import DevicePositionError, ReceiverPositionError
from radiotwin.effects.receiver_saturation import ReceiverSaturation
from radiotwin.effects.removed_obstacle import RemovedObstacle
from radiotwin.effects.sector_antenna import SectorAntenna
from radiotwin.effects.tilted_dipole import TiltedDipole

CATALOGUE: tuple[type[Effect], ...] = (
    DeviceGainOffset, ReceiverGainOffset, DeviceDrift, ReceiverDrift, ReceiverSaturation, NoiseFloor, DetectionLimit,
    SectorAntenna, TiltedDipole, BodyShadowing, ExcessAttenuation, DevicePositionError, ReceiverPositionError,
    ReceiverClockOffset, MissingObstacle, RemovedObstacle, Foliage, WallReflection, Diffraction, GroundReflection,
    Interference, LockLoss)
"""In no order: candidates compete by what the held-out links say."""
