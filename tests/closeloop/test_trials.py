"""The log of trials: nothing in it changes, and the last word on each trial counts."""

from radiotwin.closeloop.search.trials import Trial, TrialLog


def words(log):
    return [(each.name, each.kept, each.reason) for each in log.trials]


def test_a_trial_has_its_place_in_the_log_whatever_is_said_of_it_later():
    first = TrialLog().record(Trial("episode").keep(), Trial("foliage", reason="gains nothing"))
    later = first.record(Trial("receiver_gain_offset").keep())
    later = later.supersede(later.kept[0].refuse("what was found later explains it"))
    assert words(later) == [("episode", False, "what was found later explains it"),
                            ("foliage", False, "gains nothing"), ("receiver_gain_offset", True, "")]
    assert words(first) == [("episode", True, ""), ("foliage", False, "gains nothing")]
    assert [each.name for each in later.kept] == ["receiver_gain_offset"]


def test_two_trials_of_one_effect_are_two():
    log = TrialLog().record(Trial("foliage", step=1).keep(), Trial("foliage", step=1))
    assert words(log.supersede(log.trials[1].refuse("one is enough"))) == [
        ("foliage", True, ""), ("foliage", False, "one is enough")]


def test_open_is_what_nothing_speaks_against_before_it_is_kept():
    trial = Trial("foliage", step=2)
    assert trial.is_open and not trial.keep().is_open and not trial.refuse("it is not probable").is_open
    log = TrialLog().record(trial, Trial("episode", step=1))
    assert [each.name for each in log.of_step(2)] == ["foliage"]
