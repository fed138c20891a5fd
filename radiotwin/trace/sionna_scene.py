"""A city in Sionna RT, with isotropic antennas, ready to be solved."""

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

from radiotwin.errors import BadInput, RunFailed
from radiotwin.io.files import scratch_folder
from radiotwin.io.signals import deferred
from radiotwin.runtime import llvm
from radiotwin.runtime.cuda import Device
from radiotwin.runtime.processes import allowed_cores
from radiotwin.scene.city_files import CityShape, read_city, write_city
from radiotwin.scene.materials import permittivity, ranges_text

log = logging.getLogger(__name__)
City = Path | str | Sequence[CityShape] | None
"""`city.xml` of a scene folder, or what `read_city` returns; None for free space."""
_VARIANTS = {"cpu": "llvm_ad_mono_polarized", "cuda": "cuda_ad_mono_polarized"}


def library_versions() -> dict[str, str]:
    """Return the versions of the libraries that compute a gain."""
    return {f"{name.replace('-', '_')}_version": version(name)
            for name in ("sionna-rt", "mitsuba", "drjit")}


def import_sionna(device: Device = "cpu") -> Any:
    """Return the module `sionna.rt`, on a libLLVM that works, or on a GPU.

    A process traces on one of them: Sionna RT cannot change from one to the other.

    Mitsuba looks for its plugins in the working directory first, which may be the folder of a
    stranger's scene: from now on it looks for them where it is installed, and nowhere else.

    Args:
        device: `cpu`, or `cuda` for a GPU.

    Raises:
        RunFailed: No usable libLLVM or GPU, or this process traces on another device already.
    """
    if device == "cpu":
        llvm.prepare()
    with deferred():  # their compiled parts abort where Python raises while they are loaded
        import drjit
        import mitsuba

        _set_variant(mitsuba, device)
        import sionna.rt

    drjit.set_thread_count(allowed_cores())
    own = mitsuba.FileResolver()
    own.clear()
    own.append(os.path.dirname(os.path.realpath(mitsuba.__file__)))
    mitsuba.set_file_resolver(own)  # type: ignore[operator]  # as its stub says
    return sionna.rt


def _set_variant(mitsuba: Any, device: Device) -> None:
    wanted, used = _VARIANTS[device], mitsuba.variant()
    if used is None:
        try:
            mitsuba.set_variant(wanted)
        except ImportError as error:
            raise RunFailed(f"device {device}: {str(error).strip()}; `radiotwin doctor` says what "
                            "works") from None
    elif used != wanted:
        raise RunFailed(f"device {device}: Mitsuba works in its variant {used} in this process "
                        f"already, and not in {wanted}; begin a new process")


def load_city(city: City, frequency_hz: float, device: Device = "cpu") -> Any:
    """Load a city at a frequency, with one vertically polarised isotropic antenna at every end.

    Mitsuba's parser, which can load other files and plugins, gets a copy that is written from what
    `read_city` read, not the scene's own file. ITU materials outside their frequency range are
    held at its nearest end, with a warning.

    Args:
        city: `city.xml` of a scene folder, or what `read_city` returns; None for free space.
        frequency_hz: Frequency [Hz].
        device: Where it is solved.

    Returns:
        The `sionna.rt.Scene`.

    Raises:
        BadInput: The file cannot be read.
        RunFailed: As `import_sionna`.
    """
    rt = import_sionna(device)
    scene = rt.load_scene(None) if city is None else _load_copy(rt, city)
    for material in scene.radio_materials.values():
        if isinstance(material, rt.ITURadioMaterial):
            _hold_in_range(material, frequency_hz)
    scene.frequency = frequency_hz
    scene.tx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.rx_array = scene.tx_array
    return scene


def _load_copy(rt: Any, city: Path | str | Sequence[CityShape]) -> Any:
    shapes = read_city(city) if isinstance(city, Path | str) else city
    with scratch_folder() as folder:
        write_city(folder, shapes)
        try:
            return rt.load_scene(str(folder / "city.xml"))
        except (RuntimeError, ValueError, TypeError, LookupError, AttributeError, OSError,
                SyntaxError) as error:
            name = "the city" if shapes is city else city
            raise BadInput(f"{name}: Sionna RT cannot read it "
                           f"({str(error).strip()}); `radiotwin build-scene --check` lists what is "
                           "wrong with it") from None


def _hold_in_range(material: Any, frequency_hz: float) -> None:
    epsilon, conductivity, in_range = permittivity(material.itu_type, frequency_hz)
    if in_range:
        return
    log.warning("material %s: ITU-R P.2040 defines %s for %s only; at %g GHz its constants at the "
                "nearest end are used (relative permittivity %.3g, conductivity %.3g S/m)",
                material.name, material.itu_type, ranges_text(material.itu_type),
                frequency_hz / 1e9, epsilon, conductivity)
    material.frequency_update_callback = lambda _: (epsilon, conductivity)


@contextmanager
def candidate_search(table_size: int, diffraction_probability: float) -> Iterator[None]:
    """Set two constants of Sionna RT's search for candidate paths that it has no arguments for.

    Args:
        table_size: Entries of the hash table of candidates, see `radiotwin.trace.settings`.
        diffraction_probability: Share of rays that are diffracted at an edge, see there.
    """
    from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator as Search

    before = Search.MIN_SPEC_COUNT_SIZE, Search.DIFFRACTION_SAMPLING_PROBABILITY
    Search.MIN_SPEC_COUNT_SIZE = table_size
    Search.DIFFRACTION_SAMPLING_PROBABILITY = diffraction_probability
    try:
        yield
    finally:
        Search.MIN_SPEC_COUNT_SIZE, Search.DIFFRACTION_SAMPLING_PROBABILITY = before
