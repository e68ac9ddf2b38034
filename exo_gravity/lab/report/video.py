# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Where a clip goes, and whether this computer has what draws it: checked before a trial runs, not after."""

import argparse
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import one_float
from exo_gravity.lab.bag.content import Bag
from exo_gravity.lab.packages import missing

if TYPE_CHECKING:
    from rich.console import Console

FRAME_RATE = {".mp4": 25, ".gif": 10}  # frames per second
NEEDED = ("imageio", "av", "PIL")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add --video and --video-speed."""
    option = parser.add_argument
    option("--video", metavar="FILE", help="write a clip of the arms, drawn without a screen: FILE.mp4 or FILE.gif")
    option("--video-speed", type=float, default=1.0, metavar="X", help="speed of the clip (%(default)s)")


def requested(video: str | None, speed: float) -> Callable[[Bag, "Console"], None] | None:
    """Return what writes the clip of the command line of a recording, and prints where it is; None for no clip.

    Raises ParameterError for a wrong file or speed, and if a package is missing.
    """
    if video is None:
        return None
    path = Path(video)
    if path.suffix.lower() not in FRAME_RATE:
        raise ParameterError("video", video, f"a file that ends with {' or '.join(FRAME_RATE)}")
    if not path.absolute().parent.is_dir():
        raise ParameterError("video", video, "a file in a folder that exists")
    frame_rate = FRAME_RATE[path.suffix.lower()]
    step = one_float("video_speed", speed, 0.1, 100.0) / frame_rate  # s of the recording
    for module in NEEDED:
        if not find_spec(module):
            raise ParameterError("video", video, f"left out: {missing(module, 'sim')}")

    def write(bag: Bag, console: "Console") -> None:
        from exo_gravity.lab.report.clip import write_clip  # by packages that only clips need

        write_clip(bag, path, step, frame_rate, console)
        console.print(f"Clip: {path}", markup=False, soft_wrap=True)

    return write
