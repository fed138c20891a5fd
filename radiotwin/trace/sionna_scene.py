"""A city in Sionna RT, with isotropic antennas, ready to be solved."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

from radiotwin import llvm
from radiotwin.errors import BadInput
from radiotwin.scene.materials import permittivity, ranges_text

log = logging.getLogger(__name__)


def library_versions() -> dict[str, str]:
    """Versions of what computes a gain."""
    return {f"{name.replace('-', '_')}_version": version(name) for name in ("sionna-rt", "mitsuba", "drjit")}


def import_sionna():
    """The module `sionna.rt`, on a libLLVM that works.

    Raises:
        RunFailed: no usable libLLVM.
    """
    llvm.prepare()
    import sionna.rt

    return sionna.rt


def load_city(xml_path: Path | str | None, frequency_hz: float):
    """Load a scene file at a frequency. Devices and receivers get one vertically polarised isotropic antenna.

    ITU materials outside their frequency range are held at its nearest end, with a warning.

    Args:
        xml_path: Mitsuba scene file; None for free space.
        frequency_hz: frequency [Hz].

    Raises:
        BadInput: the file cannot be read.
        RunFailed: no usable libLLVM.
    """
    rt = import_sionna()
    if xml_path is not None and not Path(xml_path).is_file():
        raise BadInput(f"{xml_path} does not exist; `radiotwin build-scene` makes a scene folder")
    try:
        city = rt.load_scene(None if xml_path is None else str(xml_path))
    except (RuntimeError, ValueError, TypeError, LookupError, AttributeError, OSError, SyntaxError) as error:
        raise BadInput(f"{xml_path}: Sionna RT cannot read it ({str(error).strip()}); "
                       "`radiotwin build-scene --check` lists what is wrong with it") from None
    for material in city.radio_materials.values():
        if isinstance(material, rt.ITURadioMaterial):
            _hold_in_range(material, frequency_hz)
    city.frequency = frequency_hz
    city.tx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    city.rx_array = city.tx_array
    return city


def _hold_in_range(material, frequency_hz: float) -> None:
    relative_permittivity, conductivity, in_range = permittivity(material.itu_type, frequency_hz)
    if in_range:
        return
    log.warning("material %s: ITU-R P.2040 defines %s for %s only; at %g GHz its constants at the nearest end are "
                "used (relative permittivity %.3g, conductivity %.3g S/m)", material.name, material.itu_type,
                ranges_text(material.itu_type), frequency_hz / 1e9, relative_permittivity, conductivity)
    material.frequency_update_callback = lambda _: (relative_permittivity, conductivity)


@contextmanager
def candidate_search(table_size: int, diffraction_probability: float) -> Iterator[None]:
    """Set two constants of Sionna RT's search for candidate paths that it has no arguments for.

    Args:
        table_size, diffraction_probability: see `radiotwin.trace.settings`.
    """
    from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator as Search

    before = Search.MIN_SPEC_COUNT_SIZE, Search.DIFFRACTION_SAMPLING_PROBABILITY
    Search.MIN_SPEC_COUNT_SIZE, Search.DIFFRACTION_SAMPLING_PROBABILITY = table_size, diffraction_probability
    try:
        yield
    finally:
        Search.MIN_SPEC_COUNT_SIZE, Search.DIFFRACTION_SAMPLING_PROBABILITY = before
