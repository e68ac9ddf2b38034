"""The parameters of `panel`, and those of other nodes that its page may change."""

from __future__ import annotations

from pathlib import Path

from exo_gravity import packaged
from exo_gravity.core.compensation.params import COMPENSATOR
from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import Param

# fmt: off
PANEL = (
    Param("host", "127.0.0.1", "address of the page; other than loopback only with a token", fixed=True),
    Param("port", 8080, "TCP port of the page", (1, 65535), fixed=True),
    Param("token", "", "secret that opens the page; empty: none on loopback, elsewhere a random one in the log",
          fixed=True),
    Param("dead_man", False, "let the arms down when the page that holds control has been gone for 1 s", fixed=True),
    Param("language", "en", "language of the page until its user chooses another", choices=("en", "de"), fixed=True),
    Param("trials", "", "folder with trial scripts; empty: those of the package", fixed=True),
    Param("output", "recordings", "folder for recordings, trials and saved parameters", fixed=True),
)
# fmt: on
# What the page may change on a compensator. Every limit stays with the compensator and the bridge.
SETTABLE = {
    param.name: param
    for param in COMPENSATOR
    if param.name in ("support", "mode", "wearer.body_mass", "wearer.sex", "wearer.segment_length")
}


def scripts_folder(given: str) -> Path | None:
    """Return the folder of trial scripts: `given`, or that of the package; None if it has none.

    Raises ParameterError if `given` is not a folder.
    """
    if given:
        if not Path(given).is_dir():
            raise ParameterError("trials", given, "a folder")
        return Path(given)
    return packaged("trials")
