"""Single paths against closed forms, and against the sums that the channel uses."""

import numpy as np

from radiotwin.propagation.paths import path_powers
from radiotwin.propagation.paths.listing import DIFFRACTION, REFLECTION, follow_rays
from tests.propagation.links import FREQUENCY_HZ, WAVELENGTH_M, flat

WAVE_NUMBER = 2 * np.pi / WAVELENGTH_M


def rays_of(city, device_m, receiver_m, **settings):
    parts = list(follow_rays(city, np.array(device_m, float), np.array(receiver_m, float), FREQUENCY_HZ, **settings))
    assert sum(receivers for _, receivers in parts) == len(receiver_m)
    return [rays for rays, _ in parts]


def test_two_rays_over_the_ground_fade_as_the_exact_sum(line_of_slab):
    """A vertical dipole's far field in the plane of incidence: TM, over a half space of concrete."""
    distance_m = np.linspace(20, 300, 200)
    rays, = rays_of(flat(), [0, 0, 2], np.column_stack([distance_m, np.zeros(200), np.full(200, 40.0)]))
    assert (np.bincount(rays.receiver) == 2).all()
    direct_m, bounced_m = np.hypot(distance_m, 38), np.hypot(distance_m, 42)
    assert np.allclose(rays.length_m.reshape(-1, 2), np.column_stack([direct_m, bounced_m]), rtol=1e-12)
    bounce = np.array([line_of_slab(42 / length_m, thickness_m=np.inf)[1] for length_m in bounced_m])
    exact = np.exp(-1j * WAVE_NUMBER * direct_m) / direct_m + bounce * np.exp(-1j * WAVE_NUMBER * bounced_m) / bounced_m
    assert np.allclose(rays.amplitude.reshape(-1, 2).sum(axis=1), exact / (2 * WAVE_NUMBER), rtol=1e-8)
    level_db = 20 * np.log10(np.abs(exact * direct_m))
    assert np.ptp(level_db) > 7  # it does fade
    on_ground = rays.points_m[1::2, 0]
    assert np.allclose(on_ground, np.column_stack([distance_m * 2 / 42, np.zeros(200), np.zeros(200)]))
    assert (rays.kinds[1::2, 0] == REFLECTION).all() and not rays.kinds[::2].any() and not rays.kinds[:, 1:].any()
    assert np.allclose(rays.departure[1], [distance_m[0] / bounced_m[0], 0, -42 / bounced_m[0]])
    assert np.allclose(rays.arrival[1], [-distance_m[0] / bounced_m[0], 0, -42 / bounced_m[0]])


def test_powers_of_the_paths_add_up_to_those_of_the_channel(town, turn, monkeypatch):
    angle_rad = 0.3
    monkeypatch.setattr("radiotwin.propagation.paths.listing.RECEIVER_CHUNK", 7)
    monkeypatch.setattr("radiotwin.propagation.paths.listing.PATH_CHUNK", 100)
    device_m = turn([[0.0, 0.0, 1.5]], angle_rad)[0]
    receiver_m = turn(np.random.default_rng(0).uniform([-60, -60, 1], [100, 60, 60], (40, 3)), angle_rad)
    city = town(angle_rad)
    total = path_powers(city, device_m, receiver_m, FREQUENCY_HZ).total
    parts = rays_of(city, device_m, receiver_m)
    power = sum(np.bincount(rays.receiver, weights=np.abs(rays.amplitude) ** 2, minlength=40) for rays in parts)
    assert np.allclose(power, total, rtol=1e-9) and len(parts) == 6
    for rays in parts:
        assert (np.diff(rays.receiver) >= 0).all()
        assert ((rays.kinds == DIFFRACTION).sum(axis=1) <= 1).all()
        ends_m = receiver_m[rays.receiver]
        way_m = np.concatenate([np.broadcast_to(device_m, (len(ends_m), 1, 3)), rays.points_m], axis=1)
        legs_m = np.linalg.norm(np.diff(way_m, axis=1), axis=2)
        last_m = way_m[np.arange(len(ends_m)), (rays.kinds > 0).sum(axis=1)]
        length_m = np.nansum(legs_m, axis=1) + np.linalg.norm(ends_m - last_m, axis=1)
        assert np.allclose(length_m, rays.length_m)
        assert np.allclose(rays.arrival * np.linalg.norm(last_m - ends_m, axis=1)[:, None], last_m - ends_m)
