"""`python -m tests.fuzz --hours 1`: damage files for as long as wanted; keep the cases that fail."""

import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

# Forked children would wait for the threads of their parent, which they do not have.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS"), "1")

from tests.fuzz.cases import CORPUS, draw, listen, loads, run_case  # noqa: E402
from tests.fuzz.honest import make_honest  # noqa: E402
from tests.fuzz.targets import TARGETS  # noqa: E402

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.command()
def fuzz(
    hours: Annotated[float, typer.Option(help="How long.")] = 1.0,
    seed: Annotated[int, typer.Option(help="Seed of the cases.")] = 0,
    only: Annotated[str, typer.Option(help="Part of the kinds of files, or of the commands.")] = "",
    out: Annotated[Path | None, typer.Option(help="Counts (.json), written every minute.")] = None,
    corpus: Annotated[Path, typer.Option(help="Failed cases are added to this file.")] = CORPUS,
    again: Annotated[bool, typer.Option("--again", help="Only run the cases of the corpus.")] = False,
) -> None:
    """Damage files and run the commands that read them."""
    targets = [target for target in TARGETS if only in target.kind or only in target.command]
    rng, counts, started = random.Random(seed), Counter(), time.monotonic()
    known = [loads(line) for line in corpus.read_text().splitlines()] if corpus.exists() else []
    seen = {(case.file, case.command, case.instead, "") for case in known}
    with tempfile.TemporaryDirectory() as scratch, listen() as listener:
        honest, folder = Path(scratch) / "honest", Path(scratch) / "case"
        os.environ["RADIOTWIN_CACHE"] = str(Path(scratch) / "cache")
        make_honest(honest)
        # Numba compiles the path engine once, in a process that nothing kills.
        subprocess.run([sys.executable, "-m", "radiotwin", "map", "twin_raytrace", "--scene", "scene", "-o",
                        "../warm.nc"], cwd=honest, check=True, capture_output=True)
        print(f"honest files made in {time.monotonic() - started:.0f} s", flush=True)
        started = written = time.monotonic()
        for case in known if again else iter(lambda: draw(rng, targets), None):
            if not again and time.monotonic() - started > 3600 * hours:
                break
            outcome = run_case(case, honest, folder, listener)
            kind = case.target.kind
            counts[kind, "cases"] += 1
            counts[kind, "failed" if outcome.breaches else f"exit {outcome.status}"] += 1
            for breach in outcome.breaches:
                said = " | ".join(outcome.output.strip().splitlines()[-4:])[-600:]
                print(f"{breach}\n  {case.dumps()}\n  {said}", flush=True)
            mark = (case.file, case.command, case.instead, *outcome.breaches[:1])
            if outcome.breaches and not again and mark not in seen:
                seen.add(mark)
                with open(corpus, "a") as file:
                    file.write(case.dumps() + "\n")
            if time.monotonic() - written > 60:
                written = time.monotonic()
                _write(out, counts, written - started, seed)
    _write(out, counts, time.monotonic() - started, seed)
    failed = sum(count for (_, what), count in counts.items() if what == "failed")
    print(f"{sum(count for (_, what), count in counts.items() if what == 'cases')} cases, {failed} failed")
    sys.exit(bool(failed))


def _write(path: Path | None, counts: Counter, seconds: float, seed: int) -> None:
    table: dict[str, dict[str, int]] = {}
    for (kind, what), count in sorted(counts.items()):
        table.setdefault(kind, {})[what] = count
    record = {"command": " ".join(["python -m tests.fuzz", *sys.argv[1:]]), "seed": seed, "hours": round(seconds / 3600, 3),
              "counts": table}
    if path:
        path.write_text(json.dumps(record, indent=1) + "\n")
    else:
        print(json.dumps(table), flush=True)


if __name__ == "__main__":
    app()
