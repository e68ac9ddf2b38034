"""train_anfis: trains an ANFIS for joints 2 to 4 of an upright arm, and saves it in one readable file.

From `gravload` data by default, the paper's 1,053 positions; with --bag from the holds of a recorded rosbag2. The file
is what `law: anfis` of the compensator reads.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from exo_gravity.core.anfis_law import JOINTS
from exo_gravity.core.errors import ExoGravityError
from exo_gravity.core.tilt import SIDES
from exo_gravity.tools.anfis.data import from_gravload
from exo_gravity.tools.anfis.recorded import from_bag
from exo_gravity.tools.anfis.training import RIDGE, train_law
from exo_gravity.tools.comparison.tables import PAPER_ANFIS
from exo_gravity.tools.inputs.arms import configured_arm

RECORDED_RIDGE = 0.03  # recorded torques carry noise and stiction, which a law must not follow


def _arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="train_anfis", description="Train the ANFIS that `law: anfis` runs.")
    parser.add_argument("--params", metavar="FILE", help="ROS 2 parameter file (default: the packaged exo.yaml)")
    parser.add_argument("--side", choices=SIDES, default="right", help="which of its arms (default: right)")
    parser.add_argument("--bag", metavar="BAG", help="learn from the holds of this rosbag2 instead of from gravload")
    parser.add_argument(
        "--functions", metavar="N", type=int, choices=range(2, 7), help="per input (default: 4, for a bag 2)"
    )
    parser.add_argument("--output", metavar="FILE", default="anfis.json", help="where to save (default: anfis.json)")
    return parser.parse_args(argv)


def _run(options: argparse.Namespace) -> None:
    configured = configured_arm(options.params, options.side)
    functions = options.functions or (2 if options.bag else 4)
    samples = from_bag(options.bag, configured, functions) if options.bag else from_gravload(configured)
    law, results = train_law(samples, configured.robot, functions, RECORDED_RIDGE if options.bag else RIDGE)
    output = Path(options.output)
    output.write_text(law.dump(), encoding="utf-8")
    print(f"{law.source}; {law.model.rules} rules, {law.model.parameters} parameters a joint")
    print(f"{'joint':<6}{'training RMSE':>16}{'held-out RMSE':>16}{'the paper':>16}{'steps':>8}{'time':>9}")
    for i, (joint, result) in enumerate(zip(JOINTS, results, strict=True)):
        figures = f"{law.error['training'][i]:>13.2e} Nm{law.error['held_out'][i]:>13.2e} Nm{PAPER_ANFIS[i]:>13.2e} Nm"
        print(f"{joint:<6}{figures}{result.evaluations:>8}{result.seconds:>7.1f} s")
    print(f"saved {output}; joint 1 needs no torque while the trunk is upright, and gets none")


def main(argv: list[str] | None = None) -> None:
    """Entry point of the executable `train_anfis`."""
    options = _arguments(argv)
    try:
        _run(options)
    except (ExoGravityError, OSError) as error:
        print(f"train_anfis: {error}", file=sys.stderr)
        raise SystemExit(2) from None
