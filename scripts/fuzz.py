"""Try hostile input on everything that misstep reads; see `fuzzing`.

    python scripts/fuzz.py --list
    python scripts/fuzz.py --cases 500                         # so many of each target
    python scripts/fuzz.py --state F.json --budget 3600        # an hour of all; goes on with F.json
    python scripts/fuzz.py --target csv --case 1234 --keep F   # one case again; its input goes to F

Ends with code 1 if there was a finding. Linux only: it relies on fork and /proc.
"""

import argparse
import shutil
import sys
from pathlib import Path

from fuzzing.campaign import Campaign
from fuzzing.cases import Target, case_of, kept, tried
from fuzzing.targets import TARGETS
from fuzzing.workers import opened, scratch

from misstep.errors import MisstepError


def main() -> int:
    """Run what the command line says; return the exit code."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition(";")[0])
    parser.add_argument("--list", action="store_true", help="name the targets, and end")
    parser.add_argument("--target", action="append", choices=TARGETS, help="default: all of them")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--case", type=int, help="try this one case of the target, and tell")
    parser.add_argument("--keep", type=Path, help="folder for the input of that case")
    parser.add_argument("--cases", type=int, help="of each target; default: a million in all")
    parser.add_argument("--budget", type=float, default=float("inf"), help="seconds")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--slice", type=int, default=2000, help="cases that a worker tries")
    parser.add_argument("--state", type=Path, help="JSON file of the counts; goes on from there")
    options = parser.parse_args()
    targets = [TARGETS[name] for name in options.target or TARGETS]
    if options.list:
        for target in targets:
            print(f"{target.name:20} {target.cases}")
        return 0
    if options.case is not None:
        return _try_again(targets[0], options.seed, options.case, options.keep)
    try:
        campaign = Campaign(targets, options.seed, options.cases, options.state)
    except MisstepError as error:
        parser.error(str(error))
    campaign.run(
        options.workers, options.budget, options.slice, lambda line: print(line, flush=True)
    )
    return 1 if campaign.findings else 0


def _try_again(target: Target, seed: int, index: int, keep: Path | None) -> int:
    folder = scratch()
    try:
        attempt = opened(target, folder)
        case = case_of(target, seed, index)
        verdict = tried(attempt, case)
        print(f"{verdict.kind}: {verdict.message}")
        if keep is not None:
            print(*kept(case, keep), sep="\n")
    finally:
        shutil.rmtree(folder)
    return 1 if verdict.kind == "finding" else 0


if __name__ == "__main__":
    sys.exit(main())
