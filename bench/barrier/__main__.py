"""`make study NAME=barrier`: each rule on arms that would be thrown and on wearers who reach, as Markdown.

python -m bench.barrier [--rule NAME ...] [--case START ...] [--rate 250]
"""

from __future__ import annotations

import argparse
import sys

from .cases import INNOCENT, WRONG, felt, play
from .rules import RULES


def main() -> int:
    """Print both tables."""
    parser = argparse.ArgumentParser(prog="python -m bench.barrier", description=__doc__)
    parser.add_argument("--rule", nargs="*", choices=RULES, default=list(RULES), help="(default: all)")
    parser.add_argument("--case", nargs="*", default=[""], help="how names of cases begin (default: all)")
    parser.add_argument("--rate", type=float, default=250.0, help="of the loop, Hz (default: %(default)s)")
    arguments = parser.parse_args()
    chosen = tuple(arguments.case)
    print("| arm | rule | fastest joint (rad/s) | driven (rad/s) | by a motor (J) | (Nm/s) | fault |")
    print("|---|---|---|---|---|---|---|")
    for case in (case for case in WRONG if case.name.startswith(chosen)):
        for name in arguments.rule:
            run = play(case, RULES[name], arguments.rate)
            figures = f"{run.speed:.1f} | {run.driven:.1f} | {run.energy:.1f} | {run.rate:.0f} | {run.fault}"
            print(f"| {case.name} | {name} | {figures} |", flush=True)
    print("\n| wearer | rule | fastest joint (rad/s) | their largest torque (Nm) | mean brake (Nm) | more work (J) |")
    print("|---|---|---|---|---|---|")
    for case in (case for case in INNOCENT if case.name.startswith(chosen)):
        free = play(case, RULES["none"], arguments.rate)
        for name in arguments.rule:
            run = play(case, RULES[name], arguments.rate)
            cost = felt(run, free)
            figures = f"{run.speed:.1f} | {cost.largest:.1f} | {cost.brake:.2f} | {cost.work:.2f}"
            print(f"| {case.name} | {name} | {figures} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
