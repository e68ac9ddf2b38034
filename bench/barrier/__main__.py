# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""`make study NAME=barrier`: each rule on arms that would be thrown and on wearers who reach, as Markdown.

python -m bench.barrier [--rule NAME ...] [--case START ...] [--rate 250]
"""

from __future__ import annotations

import argparse
import sys

from ..parts import play as part_by_part
from .cases import INNOCENT, WRONG, CaseUnderRule, Motion, felt, play
from .rules import RULES

CASES = {case.name: case for case in (*WRONG, *INNOCENT)}


def played(part: CaseUnderRule) -> tuple[CaseUnderRule, Motion]:
    """Play a part."""
    return part, play(CASES[part.case], RULES[part.rule], part.rate)


def main() -> int:
    """Print both tables."""
    parser = argparse.ArgumentParser(prog="python -m bench.barrier", description=__doc__)
    parser.add_argument("--rule", nargs="*", choices=RULES, default=list(RULES), help="(default: all)")
    parser.add_argument("--case", nargs="*", default=[""], help="how names of cases begin (default: all)")
    parser.add_argument("--rate", type=float, default=250.0, help="of the loop, Hz (default: %(default)s)")
    arguments = parser.parse_args()
    rules = dict.fromkeys(("none", *arguments.rule))
    chosen = [case for case in CASES.values() if case.name.startswith(tuple(arguments.case))]
    parts = [CaseUnderRule(case.name, rule, arguments.rate) for case in chosen for rule in rules]
    found = dict(part_by_part("barrier", played, parts, lambda one: f"{one[0].case}, {one[0].rule}"))
    print("| arm | rule | fastest joint (rad/s) | driven (rad/s) | by a motor (J) | (Nm/s) | fault |")
    print("|---|---|---|---|---|---|---|")
    for part, run in found.items():
        if not CASES[part.case].is_innocent and part.rule in arguments.rule:
            figures = f"{run.speed:.1f} | {run.driven:.1f} | {run.energy:.1f} | {run.rate:.0f} | {run.fault}"
            print(f"| {part.case} | {part.rule} | {figures} |")
    print("\n| wearer | rule | fastest joint (rad/s) | their largest torque (Nm) | mean brake (Nm) | more work (J) |")
    print("|---|---|---|---|---|---|")
    for part, run in found.items():
        if CASES[part.case].is_innocent and part.rule in arguments.rule:
            cost = felt(run, found[part._replace(rule="none")])
            figures = f"{run.speed:.1f} | {cost.largest:.1f} | {cost.brake:.2f} | {cost.work:.2f}"
            print(f"| {part.case} | {part.rule} | {figures} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
