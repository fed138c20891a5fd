"""Radio maps as files that other programs read."""

from collections.abc import Callable
from pathlib import Path

from radiotwin.errors import BadInput
from radiotwin.files import atomic_path
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene


def write_netcdf(radio_map: RadioMap, scene: Scene, path: Path) -> None:
    """The whole map: `xarray.open_dataset` reads it."""
    radio_map.write(path)


def write_csv(radio_map: RadioMap, scene: Scene, path: Path) -> None:
    """One row a link: device, x_m, y_m, z_m, gain_db (empty: not detected), los, and sigma_db of a learned map."""
    table = radio_map.dataset.to_dataframe().reset_index()
    table = table.rename(columns={axis: f"{axis}_m" for axis in "xyz"})
    first = ["device", "x_m", "y_m", "z_m", "gain_db"]
    with atomic_path(path) as temporary:
        table[first + [name for name in table.columns if name not in first]].to_csv(
            temporary, index=False, float_format="%.4f")


def write_picture(radio_map: RadioMap, scene: Scene, path: Path) -> None:
    """All devices at the lowest altitude, over the city's outlines."""
    from radiotwin.figures import draw_radio_map

    draw_radio_map(radio_map, scene, path)


EXPORTERS: dict[str, Callable[[RadioMap, Scene, Path], None]] = {
    ".nc": write_netcdf, ".csv": write_csv, ".png": write_picture}


def check_format(path: Path) -> None:
    """Raise BadInput for a file name that no exporter writes."""
    if path.suffix not in EXPORTERS:
        raise BadInput(f"{path}: unknown format {path.suffix!r}; allowed are {', '.join(EXPORTERS)}")
