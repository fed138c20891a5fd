"""How long a close-loop will take, beside runs that were recorded."""

from radiotwin.closeloop.run import expected_cpu_s

RECORDED = [  # links, with a map, processor time [s]: studies real, injected, campus and speed
    (28_680, False, 200.8), (28_680, False, 101.6), (106_371, False, 632.0), (106_371, False, 276.6), (6_643, False, 49.0),
    (6_643, False, 59.5), (13_306, False, 61.0), (13_306, False, 92.5), (28_682, False, 209.8), (28_682, False, 111.8),
    (27_877, True, 368.9), (27_877, True, 338.8), (27_877, True, 261.5), (27_877, True, 426.4), (14_315, True, 146.2),
    (5_283, True, 118.9), (5_283, True, 87.6), (10_800, True, 110.0)]


def test_recorded_runs_took_half_to_twice_as_long():
    ratio = [cpu_s / expected_cpu_s(links, has_map) for links, has_map, cpu_s in RECORDED]
    assert all(0.5 < each < 2.0 for each in ratio)
    assert expected_cpu_s(10**6, True) == expected_cpu_s(60_000, True), "of very many links a sample is used"
