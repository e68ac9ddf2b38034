# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the command lines share: argument types, and messages about packages that are not installed.

A tool imports packages that only some tools need inside `extras`, after it has parsed its arguments: `--help` works
without them, and a missing one ends the tool with one line instead of a traceback.
"""

import argparse
import math
import os
import sys
from collections.abc import Callable, Sequence
from functools import partial
from io import TextIOWrapper

from exo_gravity.core.errors import ExoGravityError, ParameterError
from exo_gravity.lab.packages import MissingPackageError, extras


def _number(text: str, kind: type[float], least: int, expected: str) -> float:
    try:
        number = kind(text)
    except ValueError:
        number = math.nan
    if not number >= least:  # also for NaN
        raise argparse.ArgumentTypeError(f"{text}: must be {expected}")
    return number


# Types of arguments
non_negative = partial(_number, kind=float, least=0, expected="a number, 0 or more")
positive = partial(_number, kind=int, least=1, expected="a whole number, 1 or more")


def exit_code(tool: str, extra: str, work: Callable[[], int], failed: int = 2) -> int:
    """Return the exit code of `work`; where that raises an error, print it as one line.

    The code is then 2 for wrong use or a missing package, and `failed` for what else went wrong.

    After Ctrl-C it is 130, and 141 where the reader of the output has ended, like `head`: the shell's codes for both.
    """
    print_any_character()
    try:
        with extras(tool, extra):
            code = work()
        if sys.stdout:
            sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        print(f"{tool}: stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:
        _give_up_output()
        return 141
    except (ExoGravityError, OSError) as error:
        what = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.filename else error
        print(f"{tool}: {what}", file=sys.stderr)
        _give_up_output()
        return 2 if isinstance(error, ParameterError | MissingPackageError) else failed


def command(
    name: str,
    extra: str,
    arguments: Callable[[Sequence[str] | None], argparse.Namespace],
    run: Callable[[argparse.Namespace], int],
    failed: int = 2,
) -> Callable[[Sequence[str] | None], int]:
    """Return the entry point of a tool: it runs the command line, and returns the exit code."""

    def main(args: Sequence[str] | None = None) -> int:
        options = arguments(args)
        return exit_code(name, extra, lambda: run(options), failed)

    return main


def print_any_character() -> None:
    """Print a character that the terminal's encoding lacks as its code, in place of an exception."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _give_up_output() -> None:
    """Discard output that cannot be written. At exit Python would flush it again, and end with a traceback."""
    try:
        if sys.stdout:
            sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
