"""Damaged files through the real command line: exit 0, 2 or 130, no traceback, nothing outside, bounded.

Rationale: files of strangers are damaged or hostile; what the tool does then cannot be listed beforehand.
Expected: every outcome keeps the rule of `tests.fuzz.sandbox`.
"""

import os
from functools import partial

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from tests.fuzz.cases import CORPUS, Case, instead_of, listen, loads, run_case
from tests.fuzz.honest import make_honest
from tests.fuzz.mutations import Mutation, names
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


def cases():
    """Strategy: a target, and one to three changes of its file, or something else instead of it."""
    def of(target):
        mutation = st.builds(Mutation, st.sampled_from(names(target.suffix)), st.floats(0, 0.999999), st.integers(0, 10**6))
        changed = st.builds(partial(Case, target.file, target.command), st.lists(mutation, min_size=1, max_size=3).map(tuple))
        if target.suffix == ".args":
            return changed
        return st.one_of(*[changed] * 15, st.sampled_from(instead_of(target)).map(partial(Case, target.file, target.command, ())))
    return st.sampled_from([target for target in TARGETS if not target.slow]).flatmap(of)


@pytest.mark.parametrize("draws", [25, pytest.param(100, marks=pytest.mark.slow)])
def test_damaged_files_keep_the_rule(run, draws):
    @settings(max_examples=draws, deadline=None, derandomize=True, database=None,
              phases=(Phase.generate, Phase.shrink), suppress_health_check=list(HealthCheck))
    @given(case=cases())
    def keeps_the_rule(case):
        outcome = run(case)
        assert not outcome.breaches, f"{outcome.breaches}\n{case.dumps()}\n{outcome.output[-2000:]}"

    keeps_the_rule()


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
