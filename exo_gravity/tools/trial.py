"""trial NAME: runs a trial from start to report, on the simulated device or on a real arm.

It starts the nodes of a parameter file and a recorder, follows the script, stops the nodes, and reports the recording.
The folder of the trial holds the parameters, the recording, the nodes' log and the report. Ctrl-C, a fault or the end
of the recorder lets the arm down, and the trial reports what was recorded until then.

Exit code 0: the arm held. 1: it did not hold, or the trial did not finish. 2: wrong use or wrong file. 3: the simulated
device could not run in real time because this computer was too busy.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from exo_gravity.core.errors import ExoGravityError, ParameterError
from exo_gravity.tools.cli.arguments import non_negative
from exo_gravity.tools.cli.extras import extras
from exo_gravity.tools.inputs.parameter_file import packaged_config
from exo_gravity.tools.trials.scripts import packaged_trials
from exo_gravity.tools.video import output


def _arguments(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="trial", description="Run a trial from start to report.")
    option = parser.add_argument
    option("name", help=f"{', '.join(packaged_trials())} or a YAML file with a script")
    option("--params", metavar="FILE", help="parameter file (default: the simulated right arm)")
    option("--output", metavar="DIR", default="trials", help="where to create the trial's folder (%(default)s)")
    option("--offline", action="store_true", help="on the simulated device, without ROS and faster than real time")
    option(
        "--max-rate",
        type=non_negative,
        metavar="DEG/MIN",
        help="drift rate allowed over a hold (default: 0.2 if every hold lasts 30 s, else no limit)",
    )
    output.add_arguments(parser)
    return parser.parse_args(args)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    try:
        options = _arguments(args)
        params = Path(options.params or packaged_config("sim.yaml"))
        clip = output.requested(options.video, options.video_speed)
        with extras("trial", "report"):
            from rich.console import Console

            from exo_gravity.tools.trials import session
        request = session.Session(options.name, params, Path(options.output), options.offline, options.max_rate, clip)
        return session.run(request, Console(highlight=False))
    except ExoGravityError as error:
        print(f"trial: {error}", file=sys.stderr)
        return 2 if isinstance(error, ParameterError) else 1
