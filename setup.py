"""Put the published scenes into the wheel; everything else is declared in pyproject.toml.

The scenes stay in the folder `scenes` of the source tree, where an editable install finds them
(`radiotwin.scene.folder.published_scene`).
"""

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithScenes(build_py):
    """Copy `scenes` into the package `radiotwin`."""

    def run(self) -> None:
        """Build the packages, then copy the scene folders without what tracing left in them."""
        super().run()
        if self.editable_mode:
            return
        for path in sorted(Path("scenes").rglob("*")):
            if path.is_file() and "cache" not in path.parts:
                target = Path(self.build_lib, "radiotwin", path)
                self.mkpath(str(target.parent))
                self.copy_file(str(path), str(target))


setup(cmdclass={"build_py": BuildWithScenes})
