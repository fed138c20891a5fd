"""Damaged files through the real command line: exit 0, 2 or 130, no traceback, nothing outside, bounded.

Rationale: files of strangers are damaged or hostile; what the tool does then cannot be listed beforehand.
Expected: every outcome keeps the rule of `tests.fuzz.sandbox`.
"""

import os
import random
from functools import partial

import pytest

from tests.fuzz.cases import CORPUS, Case, draw, listen, loads, run_case
from tests.fuzz.honest import make_honest
from tests.fuzz.sandbox import CANARY, prepare_case, run_watched
from tests.fuzz.targets import TARGETS
from tests.worlds import quickened

pytestmark = [pytest.mark.usefixtures("drawn_preview"), pytest.mark.skipif(
    not hasattr(os, "fork") or not os.path.isdir("/proc/self"),
    reason="cases run in forked children that are watched through /proc")]
QUICK = {target.kind: target for target in TARGETS if not target.slow}.values()  # one of each kind
KNOWN = [loads(line) for line in CORPUS.read_text().splitlines()]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Run a case on a copy of the honest files."""
    folder = tmp_path_factory.mktemp("fuzz")
    with quickened():
        make_honest(folder / "honest")
    with listen() as listener:
        yield partial(run_case, honest=folder / "honest", folder=folder / "case", listener=listener)


@pytest.mark.parametrize("seeds", [range(25), pytest.param(range(25, 125), marks=pytest.mark.slow)])
def test_damaged_files_keep_the_rule(run, seeds):
    targets = [target for target in TARGETS if not target.slow]
    for seed in seeds:
        case = draw(random.Random(seed), targets)
        outcome = run(case)
        assert not outcome.breaches, f"{outcome.breaches}\n{case.dumps()}\n{outcome.output[-2000:]}"


@pytest.mark.parametrize("case", KNOWN, ids=[f"{case.target.kind}-{number}" for number, case in enumerate(KNOWN, start=1)])
def test_what_failed_once_keeps_the_rule(run, case):
    outcome = run(case)
    assert not outcome.breaches, f"{outcome.breaches}\n{outcome.output[-2000:]}"


@pytest.mark.parametrize("target", [
    pytest.param(target, marks=[pytest.mark.slow] * (target not in QUICK), id=f"{target.file} {target.command.partition(' ')[2]}")
    for target in TARGETS])
def test_undamaged_files_are_read(run, target):
    outcome = run(Case(target.file, target.command))
    assert outcome.status == 0 and not outcome.breaches, outcome


@pytest.mark.parametrize("program, breach", [
    ("open('../canary').read()", "reads outside"), ("open('/etc/passwd').read()", "reads outside"),
    ("open('../else', 'w')", "writes outside"), ("__import__('os').mkdir('../else')", "os.mkdir outside"),
    ("__import__('subprocess').run(['true'])", "subprocess.Popen"), ("__import__('os').system('true')", "os.system"),
    ("__import__('socket').create_connection(('127.0.0.1', PORT))", "network"), ("1 / 0", "traceback"),
    ("exit(1)", "exit status 1"), ("print('Traceback (most recent call last)')", "traceback"),
    ("open('copy', 'w').write(CANARY)", "canary in an output"), ("bytearray(3 * 2**30)", "memory above"),
    ("__import__('tempfile').mkstemp()", "left over in the temporary folder"),
    ("__import__('os').mkdir('.radiotwin-abcdefgh')", "temporary left over"), ("pass", None)])
def test_the_sandbox_sees_every_breach(tmp_path, monkeypatch, program, breach):
    (tmp_path / "honest").mkdir()
    prepare_case(tmp_path / "honest", tmp_path / "case")
    with listen() as listener:
        program = program.replace("PORT", str(listener.getsockname()[1])).replace("CANARY", repr(CANARY))
        if "bytearray" in program:
            program += "; __import__('time').sleep(5)"
        monkeypatch.setattr("tests.fuzz.sandbox.run_command", lambda module: exec(program))
        outcome = run_watched("any", tmp_path / "case", listener)
    assert any(breach in each for each in outcome.breaches) if breach else not outcome.breaches, outcome
