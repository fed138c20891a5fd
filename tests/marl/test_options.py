"""Options made of settings."""

import argparse

import pytest
from pydantic import BaseModel, Field

from marl.options import add_options, checked
from radiotwin.errors import BadInput


class Settings(BaseModel):
    count: int = Field(3, ge=1, le=9, description="how many; 50 % will do")
    share: float = Field(0.5, gt=0, description="of the whole")
    loud: bool = Field(False, description="whether it makes noise")


def parsed(*words):
    parser = argparse.ArgumentParser()
    add_options(parser, Settings, "settings", without=set())
    return parser.parse_args(words)


def test_defaults_stand_where_nothing_is_given():
    assert checked(parsed(), Settings(count=5)) == Settings(count=5)


@pytest.mark.parametrize("word, value", [("true", True), ("1", True), ("false", False), ("False", False),
                                         ("no", False), ("0", False)])
def test_booleans_parse_as_booleans(word, value):
    assert checked(parsed("--loud", word), Settings()).loud is value


@pytest.mark.parametrize("words, parts", [
    (("--count", "0"), ("--count 0", "a whole number ≥ 1, ≤ 9")),
    (("--count", "2.5"), ("--count 2.5", "a whole number")),
    (("--share", "many"), ("--share many", "a number > 0")),
    (("--loud", "perhaps"), ("--loud perhaps", "true|false"))])
def test_a_wrong_value_is_one_message_that_says_what_is_allowed(words, parts):
    with pytest.raises(BadInput) as error:
        checked(parsed(*words), Settings())
    assert all(part in str(error.value) for part in parts)
    assert "\n" not in str(error.value)


def test_help_shows_every_field_with_its_default(capsys):
    with pytest.raises(SystemExit):
        parsed("--help")
    shown = " ".join(capsys.readouterr().out.split())
    for part in ("how many; 50 % will do [3]", "of the whole [0.5]", "whether it makes noise [false]"):
        assert part in shown
