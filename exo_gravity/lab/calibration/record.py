# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The record of a tour: one line of JSON for each pose, as `calibrator` prints it."""

import json
from pathlib import Path

import numpy as np

from exo_gravity.core.compensation.tracking import Observation
from exo_gravity.core.errors import DataError


def line_of(observation: Observation) -> str:
    """Return the line of an observation, without its end."""
    return json.dumps({"observation": observation._asdict()}, default=np.ndarray.tolist)


def observations_in(record: Path, joints: int) -> list[Observation]:
    """Return what a tour of an arm of so many `joints` wrote to its `record`. Raises DataError if it is not one."""
    try:
        lines = record.read_text(encoding="utf-8").splitlines()
        observations = [Observation(**json.loads(line)["observation"]) for line in lines]
        if other := {len(one.theta) for one in observations} - {joints}:
            raise ValueError(f"poses of {other.pop()} joints")
        return observations
    except (OSError, UnicodeDecodeError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{record}: {error}: must be the record (.jsonl) of a tour of this arm") from None
