"""Two phones on one campus: compared where both were, in spite of the places where only one was."""

from radiotwin.links import prepare_links
from radiotwin.links.sites import receiver_differences


def test_they_differ_by_some_decibels_and_not_alike_for_every_sector(duke):
    links = prepare_links(duke, None)
    (found,) = receiver_differences(links)
    assert links.receiver_names[found.second] == "Samsung"
    assert found.pairs > 4000 and found.places > 300
    assert 1.0 < found.difference_db < 4.5 and 0.0 < found.low_db and 3.0 < found.high_db - found.low_db < 7.0
