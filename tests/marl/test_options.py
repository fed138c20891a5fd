"""Options made of settings."""

import pytest
import typer
from pydantic import BaseModel, Field
from typer.testing import CliRunner

from marl.settings import checked, with_settings
from radiotwin.errors import BadInput


class Settings(BaseModel):
    count: int = Field(3, ge=1, le=9, description="how many; 50 % will do")
    share: float = Field(0.5, gt=0, description="of the whole")
    loud: bool = Field(False, description="whether it makes noise")


class Others(BaseModel):
    step_m: float = Field(2.0, description="step of the grid")


def invoke(*words):
    """Exit status, output, and what the command was given."""
    seen, app = {}, typer.Typer(rich_markup_mode=None)

    @app.command()
    @with_settings(Settings, Others)
    def command(given: dict[str, str], resume: bool = False) -> None:
        seen.update(given, resume=resume)

    done = CliRunner().invoke(app, words)
    return done.exit_code, " ".join(done.output.split()), seen


def test_defaults_are_used_where_nothing_is_given():
    assert invoke() == (0, "", {"resume": False})
    assert checked({}, Settings(count=5)) == Settings(count=5)


def test_a_command_is_given_the_options_as_text_besides_its_own():
    assert invoke("--count", "4", "--step-m", "many", "--resume")[2] == {"count": "4", "step_m": "many", "resume": True}
    assert checked({"count": "4", "step_m": "many"}, Settings(count=5)) == Settings(count=4)


@pytest.mark.parametrize("given, parts", [
    ({"count": "0"}, ("--count 0", "a whole number ≥ 1, ≤ 9")), ({"count": "2.5"}, ("--count 2.5", "a whole number")),
    ({"share": "many"}, ("--share many", "a number > 0")), ({"loud": "perhaps"}, ("--loud perhaps", "true|false"))])
def test_a_wrong_value_is_one_message_that_says_what_is_allowed(given, parts):
    with pytest.raises(BadInput) as error:
        checked(given, Settings())
    assert all(part in str(error.value) for part in parts)
    assert "\n" not in str(error.value)


def test_help_shows_every_field_with_its_default():
    status, shown, _ = invoke("--help")
    assert status == 0
    for part in ("--count INTEGER How many; 50 % will do [3].", "Of the whole [0.5].",
                 "Whether it makes noise [false].", "--step-m NUMBER", "--loud true|false"):
        assert part in shown
