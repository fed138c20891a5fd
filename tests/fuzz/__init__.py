"""Fuzzing: every kind of file that the tool reads, damaged, through the real command line.

`python -m tests.fuzz --hours 1` runs it for as long as wanted; `tests/fuzz/test_fuzz.py` runs 25 cases, 100 in
`make test-all`, and all of the corpus, the cases that failed once.
"""
