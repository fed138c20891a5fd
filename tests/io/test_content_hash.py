"""Hashes of values: the same for equal content, another for any other."""

import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest

from radiotwin.effects.catalogue.gain_drift import ReceiverDrift
from radiotwin.effects.catalogue.tilted_dipole import TiltedDipole
from radiotwin.io.content_hash import Unhashable, content_hash
from radiotwin.links.links import LinkGeometry
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.materials import itu_material
from radiotwin.twin.localize import LocalizeSettings

DIFFERENT = [None, False, True, 0, 1, 0.0, -0.0, 1.0, float("nan"), "", "1", b"1", "ab", ("a", "b"), ("ab",), ((), ("a",)),
             (("a",), ()), {}, {"a": 1}, {"a": 2}, {"b": 1}, {1, 2}, np.zeros(0), np.zeros(2), np.zeros((2, 1)),
             np.zeros((1, 2)), np.zeros(2, dtype=np.float32), np.zeros(2, dtype=int), np.array([0.0, -0.0]),
             np.array(["a", "b"]), ReceiverDrift, ReceiverDrift(), ReceiverDrift(between_flights=True), LocalizeSettings(),
             LocalizeSettings(swarms=7), "\ud800"]


def test_different_values_have_different_hashes():
    assert len({content_hash(value) for value in DIFFERENT}) == len(DIFFERENT)


def test_equal_content_has_one_hash():
    array = np.arange(12.0).reshape(3, 4)
    assert content_hash(array.T) == content_hash(np.ascontiguousarray(array.T))
    assert content_hash([1, 2]) == content_hash((1, 2))
    assert content_hash({"b", "a", "c"}) == content_hash({"c", "a", "b"})
    assert content_hash({"b": 1, "a": 2}) == content_hash({"a": 2, "b": 1})
    assert content_hash(np.float64(0.1)) == content_hash(0.1)


def test_another_process_finds_the_same():
    """Rationale: Python salts the hashes of texts, and the order of sets with them, in each process."""
    text = "from radiotwin.io.content_hash import content_hash; print(content_hash(({'x', 'yy', 'zzz'}, {'k': 0.5})))"
    own = content_hash(({"x", "yy", "zzz"}, {"k": 0.5}))
    assert subprocess.run([sys.executable, "-c", text], capture_output=True, text=True).stdout.strip() == own


def test_what_an_effect_remembers_decides_nothing():
    effect = TiltedDipole()
    before = content_hash(effect)
    effect.of_links.get(LinkGeometry(np.zeros((1, 3)), np.zeros((1, 3)), np.ones(1, bool), np.zeros(1, int)), "x", list)
    assert content_hash(effect) == before


def test_a_city_is_its_triangles():
    vertices, faces = np.eye(3), np.array([[0, 1, 2]])
    one, same, other = CityMap(vertices, faces), CityMap(vertices, faces), CityMap(vertices + 1, faces)
    assert content_hash(one) == content_hash(same) != content_hash(other)
    of_glass = [CityMap(vertices, faces, [itu_material("glass", thickness_m=each)]) for each in (0.1, 0.02)]
    assert len({content_hash(each) for each in (one, *of_glass)}) == 3


@dataclass
class OfAnotherPackage:
    value: int = 1


class OwnEffect(ReceiverDrift):
    """An effect whose sources are not those of the package."""


@pytest.mark.parametrize("value", [OfAnotherPackage(), OwnEffect(), OwnEffect, object(), len, lambda: 1, np.array([None])])
def test_what_cannot_be_told_is_refused(value):
    with pytest.raises(Unhashable):
        content_hash((1, [value]))
