"""Gains averaged over the cells of a lattice, by Sionna RT's radio map solver."""

import numpy as np

from radiotwin.scene.lattice import Lattice
from radiotwin.trace.settings import SolverSettings
from radiotwin.trace.sionna_scene import City, import_sionna, load_city
from radiotwin.trace.solver import power_to_db


class CellGains:
    """Gains from one device to the cells around lattice positions, one altitude at a time.

    A cell is a horizontal square of side `lattice.step_m`, centred on its position. Its gain is the
    power that all rays carry through it: an average over 400 m² where the step is 20 m, not the
    gain at a point. So the border of a shadow is blurred, and a link in it has no sharp LoS.

    Args:
        city: `city.xml` of a scene folder, or what `read_city` returns; None for free space.
        frequency_hz: Frequency [Hz].
        settings: Settings with solver `map`.
        lattice: Positions.

    Raises:
        BadInput: The file cannot be read.
        RunFailed: No usable libLLVM.
    """

    def __init__(self, city: City, frequency_hz: float, settings: SolverSettings,
                 lattice: Lattice) -> None:
        self.settings = settings
        self.lattice = lattice
        self._city = load_city(city, frequency_hz, settings.compute_device)
        rt = import_sionna(settings.compute_device)
        self._solver = rt.RadioMapSolver()
        self._transmitter = rt.Transmitter("device", position=[0.0, 0.0, 0.0])
        self._city.add(self._transmitter)

    def solve(self, device_m: np.ndarray, z_m: float) -> np.ndarray:
        """Solve one altitude.

        Args:
            device_m: (3,) position [m].
            z_m: Altitude [m].

        Returns:
            (ny * nx,) gain [dB]; NaN where no ray came through.
        """
        import drjit

        settings, lattice = self.settings, self.lattice
        step_m = lattice.step_m
        self._transmitter.position = [float(value) for value in device_m]
        radio_map = self._solver(
            self._city,
            center=[float(np.mean(lattice.x_m)), float(np.mean(lattice.y_m)), float(z_m)],
            orientation=[0.0, 0.0, 0.0], cell_size=[step_m, step_m],
            size=[len(lattice.x_m) * step_m, len(lattice.y_m) * step_m],
            samples_per_tx=settings.samples_per_src, max_depth=settings.max_depth,
            refraction=settings.refraction, diffraction=settings.diffraction, seed=settings.seed)
        power = np.array(radio_map.path_gain, dtype=float).reshape(-1)
        del radio_map
        drjit.flush_malloc_cache()
        return power_to_db(power)
