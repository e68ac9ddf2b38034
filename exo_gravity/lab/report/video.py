# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Where a clip goes, and whether this computer has what draws it: checked before a trial runs, not after."""

import argparse
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import one_float
from exo_gravity.lab.bag.content import Bag
from exo_gravity.lab.packages import missing

if TYPE_CHECKING:
    from rich.console import Console

FRAME_RATE = {".mp4": 25, ".gif": 10}  # frames per second
NEEDED = ("imageio", "av", "PIL")
MAX_SPEED = 100.0


class Clip(NamedTuple):
    """A clip to write."""

    path: Path
    step: float  #: s of the recording from one frame to the next
    frame_rate: int  #: frames per second

    def write(self, bag: Bag, console: "Console") -> None:
        """Write the clip of a recording, and print where it is. Raises DataError."""
        from exo_gravity.lab.report.clip import write_clip  # by packages that only clips need

        write_clip(bag, *self, console)
        console.print(f"Clip: {self.path}", markup=False, soft_wrap=True)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add --video and --video-speed."""
    option = parser.add_argument
    option("--video", metavar="FILE", help="write a clip of the arms, drawn without a screen: FILE.mp4 or FILE.gif")
    option("--video-speed", type=float, default=1.0, metavar="X", help="speed of the clip (%(default)s)")


def requested(video: str | None, speed: float) -> Clip | None:
    """Return the clip of the command line, None for none.

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
    clip = Clip(path, one_float("video_speed", speed, 0.1, MAX_SPEED) / frame_rate, frame_rate)
    for module in NEEDED:
        if not find_spec(module):
            raise ParameterError("video", video, f"left out: {missing(module, 'sim')}")
    return clip
