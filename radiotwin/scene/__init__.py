"""A scene: a declared world in a folder (`scene.toml`, `city.xml`, `meshes/*.ply`)."""

from radiotwin.scene.scene import Scene

__all__ = ["Scene"]
