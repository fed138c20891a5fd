"""The radio map that a simulated flight meets: traced, statistical, or any other."""

from radiotwin.errors import BadInput
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.survey.statistical import segmented_truth


def read_truth(scene: Scene, truth: str) -> RadioMap:
    """Return the radio map that a command's option `--truth` names.

    Args:
        scene: the world to fly in.
        truth: `traced` (SCENE/truth.nc), `segmented` (statistical), or the path of a radio map.

    Raises:
        BadInput: the scene was not traced, or the file is not a radio map.
    """
    if truth == "segmented":
        return segmented_truth(scene)
    if truth == "traced":
        path = scene.folder / "truth.nc"
        if not path.is_file():
            raise BadInput(f"{path} does not exist; run `radiotwin trace {scene.folder}` first, or "
                           "use --truth segmented")
        return RadioMap.read(path)
    return RadioMap.read(truth)
