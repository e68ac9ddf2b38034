# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The file of an ANFIS law, as `train_anfis` writes it and `AnfisLaw.load` reads it."""

import json
import re

from exo_gravity.core.arm.anfis import FORMAT, INPUTS, JOINTS, PARTS, AnfisLaw


def text_of(law: AnfisLaw) -> str:
    """Return the JSON text that `AnfisLaw.load` reads, one line per rule."""
    joints = {}
    for i, joint in enumerate(JOINTS):
        joints[joint] = {f"{kind}_rmse": float(values[i]) for kind, values in law.error.items()}
        joints[joint] |= {part: getattr(law.model, part)[i].tolist() for part in PARTS}
    content = {
        "format": FORMAT,
        "about": "Takagi-Sugeno models (Jang 1993) of the holding torque in Nm of joints 2 to 4, trunk upright. "
        "Inputs: joint angles, scaled to -1..1 over the box (rad). Consequents: p_0..p_3 of each rule.",
        "source": law.source,
        "arm": {"first_moment": law.first_moment, "gravity": law.gravity},
        "box": dict(zip(INPUTS, zip(law.low, law.high, strict=True), strict=True)),
        "joints": joints,
    }
    return re.sub(r"\[[^\[\]]*\]", lambda found: " ".join(found[0].split()), json.dumps(content, indent=1)) + "\n"
