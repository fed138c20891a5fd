import numpy as np
import pytest

from radiotwin.maps.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.scene.config import SceneConfig
from radiotwin.scene.lattice import Lattice


@pytest.fixture
def scene(small_scene):
    config = small_scene.config.model_dump(by_alias=True) | {"origin": {"latitude_deg": 47.5, "longitude_deg": 8.7}}
    return Scene(small_scene.folder, SceneConfig.model_validate(config))


@pytest.fixture
def radio_map():
    """Two devices, two altitudes, 3 x 4 positions (y, x); every value another, one not detected."""
    rng = np.random.default_rng(0)
    gain_db = rng.uniform(-120, -60, (2, 2, 3, 4)).astype(np.float32)
    gain_db[1, 0, 2, 3] = np.nan
    return RadioMap.build(["d0", "d1"], Lattice.over(0, 60, 0, 40, 20, [50, 60]), gain_db, gain_db > -80,
                          gain_db * 0 + 3, {"source": "test", "frequency_hz": 2.4e9})
