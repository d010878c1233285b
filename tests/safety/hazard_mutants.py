"""Take each hazard's control out, one at a time, and see its test fail; ``make hazards``.

In a scratch copy: the checkout is not touched. Ends with exit code 1 when a test fails with its control in place, or
passes without it.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from risks import HAZARDS

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "mutation"))

from mutants import copied

HANG_S = 120


def passes(work: Path, test: str) -> bool:
    """Whether the test passes there, with that copy's code."""
    command = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", "--hypothesis-seed=0", test]
    environment = os.environ | {"PYTHONPATH": str(work), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command, cwd=work, env=environment, capture_output=True, text=True, check=False, timeout=HANG_S
        )
    except subprocess.TimeoutExpired:
        return False  # a test that hangs without the control does not pass
    if done.returncode not in (0, 1):
        raise SystemExit(f"{test} could not be run:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done.returncode == 0


def main() -> None:
    """Every hazard, or those whose test or cause holds a word."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("word", nargs="?", default="", help="only hazards that hold this word")
    parser.add_argument("--skip", type=int, default=0, help="leave out this many of the first")
    options = parser.parse_args()
    word = options.word
    bad = 0
    with tempfile.TemporaryDirectory() as temporary:
        work = copied(Path(temporary))
        known: dict[str, bool] = {}
        for hazard in HAZARDS[options.skip :]:
            if word not in " ".join(map(str, hazard.values())):
                continue
            path, test = work / hazard["file"], hazard["test"]
            good = path.read_text(encoding="utf-8")
            if good.count(hazard["old"]) != 1:
                raise SystemExit(f"{hazard['file']} does not hold the control exactly once: {hazard['old']}")
            before = known.setdefault(test, passes(work, test)) if test not in known else known[test]
            path.write_text(good.replace(hazard["old"], hazard["new"]), encoding="utf-8")
            after = passes(work, test)
            path.write_text(good, encoding="utf-8")
            verdict = "ok" if before and not after else "BAD: " + ("passes without it" if after else "fails with it")
            bad += verdict != "ok"
            print(f"{verdict:4} {hazard['id']} {hazard['cause']} | {test.rsplit('::', 1)[1]}", flush=True)
    if bad:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
