# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""train_anfis: trains an ANFIS for joints 2 to 4 of an upright arm, and saves it in one readable file.

By default it learns `gravload` torques at the paper's 1,053 positions; with --bag, the torques measured in the holds of
a rosbag2 recording. The compensator reads the file for `law: anfis`.

Exit code 0: saved. 2: wrong use, wrong file, or too few samples.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from exo_gravity.core.arm.tilt import SIDES
from exo_gravity.lab.anfis import JOINTS
from exo_gravity.lab.inputs.arms import configured_arm
from exo_gravity.lab.inputs.references import PAPER_ANFIS
from exo_gravity.tools.cli import command

RECORDED_RIDGE = 0.03  # larger, because recorded torques contain noise and stiction that the law must not learn


def _arguments(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="train_anfis", description="Train the ANFIS that `law: anfis` runs.")
    option = parser.add_argument
    option("--params", metavar="FILE", help="ROS 2 parameter file (default: the packaged exo.yaml)")
    option("--side", choices=SIDES, default="right", help="which of its arms (default: right)")
    option("--bag", metavar="BAG", help="learn from the holds of this rosbag2 recording instead of from gravload")
    option(
        "--functions", metavar="N", type=int, choices=range(2, 7),
        help="membership functions per input (default: 4, for a bag 2)",
    )  # fmt: skip
    option("--output", required=True, metavar="FILE", help="where to save the law, e.g. anfis.json")
    return parser.parse_args(args)


def _run(options: argparse.Namespace) -> int:
    """Train, save the law and print its errors; return 0."""
    from exo_gravity.lab.anfis import text_of
    from exo_gravity.lab.anfis_training import RIDGE, from_bag, from_gravload, train_law

    output = Path(options.output)
    configured = configured_arm(options.params, options.side)
    functions = options.functions or (2 if options.bag else 4)
    if options.bag:
        samples, ridge = from_bag(options.bag, configured, functions), RECORDED_RIDGE
    else:
        samples, ridge = from_gravload(configured), RIDGE
    law, results = train_law(samples, configured.paper_arm, functions, ridge)
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(text_of(law), encoding="utf-8")
    print(f"{law.source}; {law.model.rules} rules, {law.model.parameters} parameters per joint")
    print(f"{'joint':<6}{'training RMSE':>16}{'held-out RMSE':>16}{'the paper':>16}{'steps':>8}{'time':>9}")
    for i, (joint, result) in enumerate(zip(JOINTS, results, strict=True)):
        figures = f"{law.error['training'][i]:>13.2e} Nm{law.error['held_out'][i]:>13.2e} Nm{PAPER_ANFIS[i]:>13.2e} Nm"
        print(f"{joint:<6}{figures}{result.evaluations:>8}{result.seconds:>7.1f} s")
    print(f"saved {output}; it gives joint 1 no torque, which needs none while the trunk is upright")
    return 0


main = command("train_anfis", "report,validate", _arguments, _run)
