# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The rows: each driver of an IMU once, with ordinary motors, wire formats, rates and computers by turns."""

from __future__ import annotations

from dataclasses import dataclass

from .arm import Equipment, OrdinaryArm, Result
from .drivers import ordinary_drivers
from .motors import Electronics

MARGIN = 120.0  # s; the last start may take that long
CARRIED = 24.0  # s, of each start
EQUIPMENT = (
    Equipment("quick motors", Electronics(0.001, 0.005, torque_noise=0.15), (0.1, 0.1), 0.01),
    Equipment(
        "slow motors, batches",
        Electronics(0.008, 0.001, torque_noise=0.03),
        (0.3, 0.2),
        loss=0.03,
        batch=0.001,
    ),
    Equipment(
        "noisy motors, busy computer",
        Electronics(0.004, 0.003, torque_noise=0.15),
        (0.2, 0.1),
        loss=0.03,
        batch=0.001,
        late=0.1,
    ),
    Equipment("ideal motors, busy computer", None, late=0.1),
)
RATES = (100.0, 250.0, 500.0)  # Hz
V3_RATES = (100.0, 250.0, 400.0)  # Hz: each cycle waits for a status frame


@dataclass(frozen=True)
class Row:
    """One arm. rate: Hz of the control loop. driver: name of the IMU's."""

    equipment: Equipment
    is_v3: bool
    rate: float
    driver: str

    @property
    def name(self) -> str:
        """What is played."""
        return f"{self.equipment.name}; {'V3' if self.is_v3 else 'V1/V2'}, {self.rate:g} Hz; IMU: {self.driver}"

    def play(self, duration: float, carried: float = CARRIED) -> Result:
        """Play `duration` s, and until the last start has ended."""
        timing = ordinary_drivers(duration + MARGIN)[self.driver]
        return OrdinaryArm(self.equipment, self.is_v3, self.rate, timing).play(duration, carried)


def all_rows() -> list[Row]:
    """Return every row."""
    rows = []
    for number, driver in enumerate(ordinary_drivers(1.0)):
        is_v3 = number // 4 % 2 == 1
        rate = (V3_RATES if is_v3 else RATES)[number % 3]
        rows.append(Row(EQUIPMENT[number % 4], is_v3, rate, driver))
    return rows
